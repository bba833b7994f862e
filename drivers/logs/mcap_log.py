"""Solutions and events as MCAP for Foxglove: JSON messages, each topic with its schema.

Frames for display are east, north, up of the first navigated place (``map``) and forward, left, up of the body
(``base_link``); the numbers of ``/state`` are ours (north, east, down). Times are host time of the samples' arrival.
"""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from drivers.mavlink.solution import Home
from nav.errors import HilError
from nav.rotation import euler_from_quaternion
from nav.state import NAV_STATE, Health, Mode

CHUNK = 1 << 17
"""Bytes of messages in one chunk: what a killed process loses at most."""
SLOW_S = 0.02
"""Shortest device time between two messages of every topic but ``/imu``."""
_LEVELS = {"info": 2, "notice": 2, "warning": 3, "error": 4}
_HALF = math.sqrt(0.5)

_NUMBER, _TEXT = {"type": "number"}, {"type": "string"}


def _object(title: str, **properties: Any) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": properties}


def _numbers(count: int) -> dict[str, Any]:
    return {"type": "array", "items": _NUMBER, "minItems": count, "maxItems": count}


_TIME = _object("time", sec={"type": "integer", "minimum": 0}, nsec={"type": "integer", "minimum": 0})
_XYZ = _object("foxglove.Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_XYZW = _object("foxglove.Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE = _object("foxglove.Pose", position=_XYZ, orientation=_XYZW)
SCHEMAS = {
    "/imu": _object(
        "dtg_hil.Imu", timestamp=_TIME, device_time_s=_NUMBER, sequence={"type": "integer"},
        angular_velocity=_XYZ, specific_force=_XYZ, gyro_bias=_XYZ,
    ),
    "/state": _object(
        "dtg_hil.NavState", timestamp=_TIME, device_time_s=_NUMBER, mode=_TEXT, health=_TEXT, progress=_NUMBER,
        lat_deg=_NUMBER, lon_deg=_NUMBER, height_m=_NUMBER, vel_n=_numbers(3), q_nb=_numbers(4),
        heading_deg=_NUMBER, pitch_deg=_NUMBER, roll_deg=_NUMBER, sigma=_numbers(9),
    ),
    "/tf": _object(
        "foxglove.FrameTransform", timestamp=_TIME, parent_frame_id=_TEXT, child_frame_id=_TEXT, translation=_XYZ, rotation=_XYZW
    ),
    "/pose": _object("foxglove.PoseInFrame", timestamp=_TIME, frame_id=_TEXT, pose=_POSE),
    "/location": _object(
        "foxglove.LocationFix", timestamp=_TIME, frame_id=_TEXT, latitude=_NUMBER, longitude=_NUMBER, altitude=_NUMBER,
        position_covariance=_numbers(9), position_covariance_type={"type": "integer"},
    ),
    "/log": _object(
        "foxglove.Log", timestamp=_TIME, level={"type": "integer"}, message=_TEXT, name=_TEXT, file=_TEXT,
        line={"type": "integer"},
    ),
}  # fmt: skip
"""JSON schema of each topic; those of Foxglove have the names and fields that it knows."""


class McapLog:
    """One file; use as a context manager.

    Parameters
    ----------
    path : Path
        Overwritten if it exists.

    Raises
    ------
    HilError
        The file cannot be created, or the package is missing.
    """

    def __init__(self, path: Path) -> None:
        try:
            from mcap.writer import Writer
        except ImportError as error:
            raise HilError("MCAP needs a package that is not installed: pip install 'dtg-hil[mcap]'") from error
        try:
            self._file: BinaryIO = path.open("wb")
        except OSError as error:
            raise HilError(f"MCAP file {path}: {error.strerror}") from error
        self.path = path
        self.written = 0
        """Messages."""
        self._writer = Writer(self._file, chunk_size=CHUNK)
        self._writer.start(library="dtg-hil")
        self._channels = {
            topic: self._writer.register_channel(
                topic, "json", self._writer.register_schema(schema["title"], "jsonschema", json.dumps(schema).encode())
            )
            for topic, schema in SCHEMAS.items()
        }
        self._origin: Home | None = None
        self._slow_at = -math.inf
        self._last_ns = 0

    def solutions(self, rows: NDArray[Any]) -> None:
        """Append solutions, rows of `NAV_STATE`."""
        for row in rows:
            values = dict(zip(NAV_STATE.names or (), row.item(), strict=True))
            self._last_ns = max(int(values["arrival_ns"]), 0)
            self._put("/imu", self._last_ns, _imu(values))
            if abs(values["time"] - self._slow_at) < SLOW_S - 1e-9:
                continue
            self._slow_at = values["time"]
            for topic, message in self._slow(values):
                self._put(topic, self._last_ns, message)

    def note(self, severity: str, text: str) -> None:
        """Append an event, at the time of the newest solution."""
        level = _LEVELS.get(severity, 0)
        self._put("/log", self._last_ns, {"level": level, "message": text, "name": "hil", "file": "", "line": 0})

    def flush(self) -> None:
        """Hand whole chunks to the system."""
        self._file.flush()

    def close(self) -> None:
        """Write index and summary, and close."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()

    def __enter__(self) -> "McapLog":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _put(self, topic: str, time_ns: int, message: dict[str, Any]) -> None:
        stamped = {"timestamp": {"sec": time_ns // 10**9, "nsec": time_ns % 10**9}, **message}
        data = json.dumps(stamped, allow_nan=False, separators=(",", ":")).encode()
        self._writer.add_message(self._channels[topic], time_ns, data, time_ns)
        self.written += 1

    def _slow(self, values: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
        yield "/state", _state(values)
        if values["mode"] < Mode.NAVIGATE:
            return
        place = Home(values["lat"], values["lon"], values["height"])
        self._origin = self._origin or place
        north, east, down = self._origin.offset(place)
        pose = {"position": _vector((east, north, -down)), "orientation": _flu_to_enu(values["q_nb"])}
        yield "/pose", {"frame_id": "map", "pose": pose}
        yield (
            "/tf",
            {
                "parent_frame_id": "map",
                "child_frame_id": "base_link",
                "translation": pose["position"],
                "rotation": pose["orientation"],
            },
        )
        yield "/location", _location(values)


def _imu(values: dict[str, Any]) -> dict[str, Any]:
    return {
        "device_time_s": values["time"],
        "sequence": values["sequence"],
        "angular_velocity": _vector(values["w_ib_b"].tolist()),
        "specific_force": _vector(values["f_b"].tolist()),
        "gyro_bias": _vector(values["gyro_bias"].tolist()),
    }


def _state(values: dict[str, Any]) -> dict[str, Any]:
    sigma = values["sigma"]
    message = {
        "device_time_s": values["time"],
        "mode": Mode(values["mode"]).name.lower(),
        "health": "|".join(flag.name.lower() for flag in Health(values["health"]) if flag.name) or "good",
        "progress": values["progress"],
        "lat_deg": math.degrees(values["lat"]),
        "lon_deg": math.degrees(values["lon"]),
        "height_m": values["height"],
        "vel_n": values["vel_n"].tolist(),
    }
    if values["mode"] >= Mode.NAVIGATE:
        angles = np.degrees(euler_from_quaternion(values["q_nb"])).tolist()
        message |= dict(zip(("heading_deg", "pitch_deg", "roll_deg"), angles, strict=True))
        message["q_nb"] = values["q_nb"].tolist()
    if np.isfinite(sigma).all():
        message["sigma"] = sigma.tolist()
    return message


def _location(values: dict[str, Any]) -> dict[str, Any]:
    north, east, down = values["sigma"][:3].tolist()
    known = all(math.isfinite(one) for one in (north, east, down))
    variances = [east**2, 0.0, 0.0, 0.0, north**2, 0.0, 0.0, 0.0, down**2] if known else [0.0] * 9
    return {
        "frame_id": "base_link",
        "latitude": math.degrees(values["lat"]),
        "longitude": math.degrees(values["lon"]),
        "altitude": values["height"],
        "position_covariance": variances,
        "position_covariance_type": 2 if known else 0,
    }


def _vector(values: list[float] | tuple[float, float, float]) -> dict[str, float]:
    return dict(zip("xyz", values, strict=True))


def _flu_to_enu(q_nb: Any) -> dict[str, float]:
    """q_nb between east, north, up and forward, left, up: half a turn about (1, 1, 0) before, about x behind."""
    w, x, y, z = (float(one) for one in q_nb)
    # (0, h, h, 0) * q * (0, 1, 0, 0)
    pw, px, py, pz = -_HALF * (x + y), _HALF * (w + z), _HALF * (w - z), _HALF * (y - x)
    return {"w": -px, "x": pw, "y": pz, "z": -py}
