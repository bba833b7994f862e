"""Autopilot feeds: processes that give the solution to an autopilot in the form in which it takes a simulator or a sensor.

`config` is what a scenario says, `tap` reads the ring of solutions, `ardupilot`, `px4` and `vectornav` speak to the autopilot,
`process` runs one of them, `quantisation` tells where the autopilot rounds more coarsely than the sensor is noisy.
"""
