"""Comparison with what came with a log: the autopilot's own estimate of the attitude, and the track of its receiver."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.geometry import Spread, attitude_difference, position_error
from nav.aiding import AIDING
from nav.increments import FloatArray
from nav.state import Mode
from nav.turn import multiply, normalise, quaternion_of

SETTLE_S = 10.0
"""Time from the start of the log that is not compared."""


@dataclass(slots=True)
class Trace:
    """Every attitude and position of a run, kept for the comparison at its end."""

    times: list[FloatArray] = field(default_factory=list)
    attitudes: list[FloatArray] = field(default_factory=list)
    places: list[FloatArray] = field(default_factory=list)

    def add(self, rows: NDArray[Any]) -> None:
        """Take solutions (`NAV_STATE`) that have an attitude."""
        good = rows[rows["mode"] >= Mode.NAVIGATE]
        self.times.append(good["time"].copy())
        self.attitudes.append(good["q_nb"].copy())
        self.places.append(np.column_stack([good["lat"], good["lon"], good["height"], good["sigma"][:, :3]]))

    def arrays(self) -> tuple[FloatArray, FloatArray]:
        """(n,) times and (n, 4) attitudes."""
        return np.concatenate(self.times), np.concatenate(self.attitudes)


@dataclass(frozen=True, slots=True)
class Reference:
    """Another estimator's attitude.

    Attributes
    ----------
    time : (n,) float
        Device time, s.
    q_nb : (n, 4) float
        Its attitude.
    gyro_time, gyro : (m,), (m, 3) float
        The raw rates of the log, rad/s, for the baseline of plain integration.
    start : float
        Device time of the log's start, s.
    fixes : (k,) array of AIDING
        Of one receiver, in the order of their times.
    """

    time: FloatArray
    q_nb: FloatArray
    gyro_time: FloatArray
    gyro: FloatArray
    start: float
    fixes: NDArray[Any] = field(default_factory=lambda: np.zeros(0, AIDING))

    def differences(self, trace: Trace) -> dict[str, Any]:
        """``difference`` of our attitude and ``baseline`` of plain gyro integration, from `SETTLE_S` on, degrees.

        With fixes, ``difference`` has that of our position from all of them too, also from those that were withheld; and
        ``position_sigma``, the same of each axis over what the filter and the receiver say of it.
        """
        times, attitudes = trace.arrays() if trace.times else (np.zeros(0), np.zeros((0, 4)))
        difference = self._compare(times, attitudes)
        if difference is not None:
            difference |= self._compare_track(times, np.concatenate(trace.places))
        return {"difference": difference, "baseline": self._compare(*self._plain())}

    def chosen(self, times: FloatArray) -> NDArray[np.bool_]:
        """The reference samples that are compared with a solution at `times`."""
        if len(times) == 0:
            return np.zeros(len(self.time), bool)
        chosen: NDArray[np.bool_] = (self.time >= max(self.start + SETTLE_S, times[0])) & (self.time <= times[-1])
        return chosen

    def errors(self, times: FloatArray, attitudes: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """(time, total, tilt, heading) of the difference at each compared reference sample, s and rad."""
        chosen = self.chosen(times)
        at = self.time[chosen]
        return (at, *attitude_difference(interpolate_attitude(times, attitudes, at), self.q_nb[chosen]))

    def _compare(self, times: FloatArray, attitudes: FloatArray) -> dict[str, Any] | None:
        if not self.chosen(times).any():
            return None
        _, *parts = self.errors(times, attitudes)
        return _spreads(dict(zip(("total_deg", "tilt_deg", "heading_deg"), parts, strict=True)), 180.0 / np.pi)

    def _compare_track(self, times: FloatArray, places: FloatArray) -> dict[str, Any]:
        at = self.fixes["time"]
        fixes = self.fixes[(at >= max(self.start + SETTLE_S, times[0])) & (at <= times[-1])]
        if not len(fixes):
            return {}
        lat, lon, height, *sigma = (np.interp(fixes["time"], times, column) for column in places.T)
        track = dict(zip(("lat", "lon", "height"), fixes["value"][:, :3].T, strict=True))
        error = position_error(lat, lon, height, track)
        parts = {"horizontal_m": np.hypot(error[:, 0], error[:, 1]), "vertical_m": error[:, 2]}
        known = np.isfinite(sigma).all(axis=0)
        if known.any():
            expected = np.hypot(np.stack(sigma, axis=1), fixes["sigma"][:, :3])
            parts["position_sigma"] = (error / expected)[known].ravel()
        return _spreads(parts)

    def _plain(self) -> tuple[FloatArray, FloatArray]:
        """Attitude by plain integration of the raw rates from the reference's first attitude."""
        first = int(np.searchsorted(self.gyro_time, self.time[0]))
        times = self.gyro_time[first:]
        attitudes = np.empty((len(times), 4))
        q = self.q_nb[0].copy()
        for k in range(len(times)):
            if k:
                turn = self.gyro[first + k] * (times[k] - times[k - 1])
                multiply(q, np.array(quaternion_of(turn[0], turn[1], turn[2])), q)
                normalise(q)
            attitudes[k] = q
        return times, attitudes


def _spreads(parts: dict[str, FloatArray], scale: float = 1.0) -> dict[str, Any]:
    result = {}
    for name, values in parts.items():
        spread = Spread()
        spread.add(np.ascontiguousarray(values))
        result[name] = spread.as_dict(scale)
    return result


def interpolate_attitude(times: FloatArray, q: FloatArray, at: FloatArray) -> FloatArray:
    """Attitudes (n, 4) at times inside `times`, linear in the quaternion and normalised (steps are short)."""
    right = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    span = times[right] - times[right - 1]
    weight = np.where(span > 0, (at - times[right - 1]) / np.where(span > 0, span, 1.0), 0.0)[:, None]
    a, b = q[right - 1], q[right]
    b = np.where(np.sum(a * b, axis=1, keepdims=True) < 0, -b, b)
    mixed = a * (1 - weight) + b * weight
    result: FloatArray = mixed / np.linalg.norm(mixed, axis=1, keepdims=True)
    return result
