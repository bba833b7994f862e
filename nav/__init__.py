"""Strapdown inertial navigation: pure mathematics, no I/O, no clock, no files.

Frames
------
i : Earth-centred inertial, z along the Earth's axis, coincides with e at t = 0 of a run.
e : Earth-centred Earth-fixed, WGS-84.
n : local level North-East-Down at the vehicle.
w : wander azimuth, level, Z up, Y at azimuth A clockwise from north; inside the wander mechanization only.
b : body Forward-Right-Down.

Names
-----
``C_ab``, ``q_ab``
    Take a vector from b to a: ``v_a = C_ab @ v_b``. Quaternions are Hamilton, scalar first, same rotation.
``w_ab_c``
    Angular rate of b relative to a, in c axes (rad/s).
``f_b``
    Specific force: what an ideal accelerometer measures (m/s^2); at rest and level ``(0, 0, -g)``.
``dtheta``, ``dvel``
    Integrals of ``w_ib_b`` (rad) and ``f_b`` (m/s) over one step, in body axes.
``vel_n``
    Velocity relative to the Earth: north, east, down (m/s).

Euler angles are yaw-pitch-roll (3-2-1) from n to b: heading in [0, 2 pi), pitch in [-pi/2, pi/2], roll in (-pi, pi].
Units are SI; degrees, knots and g live at the edges only, with the unit in the name (``heading_deg``). Heights are
ellipsoidal.
"""
