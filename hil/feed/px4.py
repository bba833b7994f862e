"""The feed to PX4 by its simulator interface: PX4 connects over TCP, and each HIL_SENSOR waits for the actuators of the last."""

import math
import time
from collections import Counter, deque
from collections.abc import Iterator
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mav

from drivers.mavlink import px4
from drivers.mavlink.link import Listener, open_link
from drivers.mavlink.sole import SoleClient
from drivers.mavlink.solution import Solution
from hil.feed.common import Commanded, Maker, Socket
from hil.feed.config import FeedConfig
from hil.feed.tap import Tap
from hil.scenario import Scenario
from nav.errors import HilError

SLOW_SENSORS_HZ = 50.0
"""Magnetometer and barometer."""
LOCKSTEP_S = 0.2
"""Longest wait for the actuators."""
_REMEMBERED = 64
"""Newest times of HIL_SENSOR: actuators of an older one do not stand for those of the newest."""
_BEAT_S = 1.0
_PIECES = 16
"""Pieces of input that are taken before something is sent."""
_SYSTEM, _COMPONENT = 1, mav.MAV_COMP_ID_USER1


class Px4Feed:
    """See the module; satisfies `hil.feed.common.Feed`."""

    def __init__(self, config: FeedConfig, scenario: Scenario, joint: Socket) -> None:
        try:
            listener = open_link(config.listens)
        except HilError as error:
            raise HilError(f"feed {config.name}: {error}") from error
        assert isinstance(listener, Listener)
        self._link = SoleClient(listener)
        self.place = f"tcp {config.place.rpartition(':')[0]}:{listener.port}"
        self._period, self._gps_s = 1.0 / config.rate_hz, 1.0 / config.gps_hz
        self._derived, self._claim = config.derived, px4.Claim(config.claim_m, config.claim_ms)
        self._paced = joint.gate is None
        self._make, self._commanded = Maker(config, scenario), Commanded(joint.actuators)
        self._tap = Tap(joint.states, joint.gate, joint.number)
        self.sent: Counter[str] = Counter()
        self.received: Counter[str] = Counter()
        self.hungry = False
        self.heard_s = -1.0
        self.bad_data = self.dropped = self.timeouts = 0
        self._time_s = self._began = self._ended = 0.0
        self._connection = 0
        self._renew()

    def _renew(self) -> None:
        """Begin with an autopilot that knows nothing yet."""
        self._mav = mav.MAVLink(None, _SYSTEM, _COMPONENT)
        self._mav.robust_parsing = True
        self._lockstep = self._awaiting = False
        self._sent_us: deque[int] = deque(maxlen=_REMEMBERED)
        self._sent_s = self._beat_s = -1e9
        self._slow_due = self._gps_due = self._state_due = 0.0
        self._state_s: float | None = 0.0
        self._tap.skip()

    def fileno(self) -> int:
        """Descriptor to wait on for reading; constant."""
        return self._link.fileno()

    def step(self, now_s: float) -> float:
        """See `Feed.step`."""
        self.hungry = False
        for _ in range(_PIECES):
            data = self._link.receive()
            if self._link.connections != self._connection:
                self._connection = self._link.connections
                self._renew()
            if not data:
                break
            self.heard_s = now_s
            for message in self._parsed(data):
                self._take(message)
        if not self._link.ready():
            return now_s + _BEAT_S
        if now_s - self._beat_s >= _BEAT_S:
            self._beat_s = now_s
            self._send(px4.heartbeat())
        if self._awaiting and now_s - self._sent_s > LOCKSTEP_S:
            self._awaiting = False
            self.timeouts += 1
        if self._awaiting:
            return self._sent_s + LOCKSTEP_S + 1e-3
        if not (self._paced or self._lockstep) and now_s < self._sent_s + self._period:
            return self._sent_s + self._period  # simulated time goes with the clock until PX4 holds it
        rows = self._tap.take(self._period)
        solution = None if rows is None else self._make.solution(rows)
        if solution is None:
            self.hungry = True
            return now_s + _BEAT_S
        self._feed(solution)
        self._sent_s, self._awaiting = now_s, self._lockstep
        return now_s

    def _parsed(self, data: bytes) -> Iterator[Any]:
        try:
            messages = self._mav.parse_buffer(data) or []
        except mav.MAVError:
            self.bad_data += 1
            return
        for message in messages:
            if message.get_type() == "BAD_DATA":
                self.bad_data += 1
            else:
                self.received[message.get_type()] += 1
                yield message

    def _take(self, message: Any) -> None:
        kind = message.get_type()
        if kind == "HIL_ACTUATOR_CONTROLS":
            controls = px4.controls_of(message)
            if controls is None:
                self.bad_data += 1
                return
            self._commanded.tell(self._time_s, controls.values, armed=controls.armed)
            late = message.time_usec in self._sent_us and message.time_usec != self._sent_us[-1]
            self._lockstep, self._awaiting = controls.lockstep, controls.lockstep and self._awaiting and late
        elif kind == "COMMAND_LONG":
            wanted = message.command == mav.MAV_CMD_SET_MESSAGE_INTERVAL and math.isfinite(message.param2)
            known = wanted and message.param1 == mav.MAVLINK_MSG_ID_HIL_STATE_QUATERNION
            if known:
                self._state_s = None if message.param2 < 0.0 else 1e-6 * message.param2
            result = mav.MAV_RESULT_ACCEPTED if known else mav.MAV_RESULT_UNSUPPORTED
            self._send(mav.MAVLink_command_ack_message(message.command, result))

    def _feed(self, solution: Solution) -> None:
        """HIL_SENSOR comes last: what goes before belongs to the moment to which it sets PX4's clock."""
        now, fields = solution.time, px4.ACCELEROMETER | px4.GYRO
        self._time_s = now
        around, messages = None, []
        if self._derived and now >= self._gps_due:
            self._gps_due = _next(self._gps_due, self._gps_s, now)
            messages.append(px4.hil_gps(solution, self._claim))
        if self._state_s is not None and now >= self._state_due:
            self._state_due = _next(self._state_due, self._state_s, now)
            messages.append(px4.hil_state_quaternion(solution))
        if self._derived and now >= self._slow_due:
            self._slow_due = _next(self._slow_due, 1.0 / SLOW_SENSORS_HZ, now)
            around = self._make.around(solution)
            fields |= px4.MAGNETOMETER | px4.BAROMETER
        if self.sent["HIL_SENSOR"] % round(1.0 / self._period) == 0:
            messages.append(px4.system_time(solution))
        sensor = px4.hil_sensor(solution, around, fields)
        self._sent_us.append(sensor.time_usec)
        self._send(*messages, sensor)
        self._ended = time.monotonic()
        self._began = self._began or self._ended

    def _send(self, *messages: Any) -> None:
        """Send messages together: PX4 is woken once."""
        data = b""
        for message in messages:
            data += message.pack(self._mav)
            self._mav.seq = (self._mav.seq + 1) % 256
        if self._link.send(data):
            self.sent.update(message.get_type() for message in messages)
        else:
            self.dropped += len(messages)

    def counters(self) -> dict[str, Any]:
        """See `Feed.counters`."""
        frames, seconds = self.sent["HIL_SENSOR"], self._ended - self._began
        return {
            "frames": frames,
            "frames_hz": (frames - 1) / seconds if seconds > 0.0 else 0.0,
            "sent": dict(self.sent),
            "received": dict(self.received),
            "timeouts": self.timeouts,
            "bad_data": self.bad_data,
            "refused": self._link.refused,
            "connections": self._link.connections,
            "dropped": self.dropped,
            "lost_solutions": self._tap.lost,
            "actuators": self._commanded.summary(),
        }

    def close(self) -> None:
        """Give everything back."""
        self._link.close()


def _next(due: float, interval: float, now: float) -> float:
    """The moment after `due`, or after `now` where that is long past."""
    return due + interval if now < due + interval else now + interval
