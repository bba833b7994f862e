"""MCAP files, read back with the library's own readers; frames and schemas with peers."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
import pytest
from scipy.spatial.transform import Rotation

from drivers.logs.mcap_log import SCHEMAS, McapLog
from nav.errors import HilError
from nav.rotation import quaternion_from_euler
from nav.state import NAV_STATE, Health, Mode

pytest.importorskip("mcap")
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, make_reader


def rows(n: int, start_s: float = 100.0, rate_hz: float = 1000.0) -> Any:
    made = np.zeros(n, NAV_STATE)
    made["time"] = start_s + np.arange(n) / rate_hz
    made["arrival_ns"] = 1_800_000_000_000_000_000 + np.round(np.arange(n) * 1e9 / rate_hz).astype(np.int64)
    made["sequence"] = np.arange(n)
    made["mode"] = Mode.NAVIGATE
    made["lat"], made["lon"], made["height"] = 0.87, 0.63, 150.0
    made["q_nb"] = quaternion_from_euler(0.7, 0.2, -0.4)
    made["sigma"] = np.inf
    return made


def read(path: Path) -> dict[str, list[tuple[int, dict[str, Any]]]]:
    found: dict[str, list[tuple[int, dict[str, Any]]]] = {topic: [] for topic in SCHEMAS}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            assert json.loads(schema.data)["title"] == schema.name
            found[channel.topic].append((message.log_time, json.loads(message.data)))
    return found


def conforms(value: Any, schema: dict[str, Any]) -> bool:
    kind = schema["type"]
    if kind == "object":
        return isinstance(value, dict) and all(
            key in schema["properties"] and conforms(part, schema["properties"][key]) for key, part in value.items()
        )
    if kind == "array":
        return len(value) == schema["minItems"] and all(conforms(part, schema["items"]) for part in value)
    if kind == "integer":
        return isinstance(value, int)
    return isinstance(value, str) if kind == "string" else isinstance(value, int | float)


def test_everything_comes_back_by_its_schema(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    made = rows(2000)
    made["mode"][:500] = Mode.ALIGN
    made["health"] = int(Health.UNAIDED | Health.SPARE)
    made["sigma"][1000:] = 2.0
    with McapLog(path) as log:
        log.solutions(made)
        log.note("warning", "something")
    found = read(path)
    assert sum(len(messages) for messages in found.values()) == log.written
    for topic, messages in found.items():
        assert all(conforms(message, SCHEMAS[topic]) for _, message in messages), topic
    assert [message["sequence"] for _, message in found["/imu"]] == list(range(2000))
    assert len(found["/state"]) == 100
    assert len(found["/pose"]) == len(found["/tf"]) == len(found["/location"]) == 75
    assert found["/state"][0][1]["mode"] == "align"
    assert "q_nb" not in found["/state"][0][1]
    assert set(found["/state"][-1][1]["health"].split("|")) == {"unaided", "spare"}
    assert {message["position_covariance_type"] for _, message in found["/location"]} == {0, 2}
    assert found["/location"][-1][1]["position_covariance"] == [4.0, 0, 0, 0, 4.0, 0, 0, 0, 4.0]
    assert found["/log"][0][1]["level"] == 3
    stamp = found["/imu"][7][1]["timestamp"]
    assert stamp["sec"] * 10**9 + stamp["nsec"] == found["/imu"][7][0] == made["arrival_ns"][7]


def test_the_pose_is_that_of_a_peer(tmp_path: Path) -> None:
    made = rows(100)
    made["lat"][1:] += 1e-4
    made["lon"][1:] -= 2e-4
    made["height"][1:] += 30.0
    with McapLog(tmp_path / "a.mcap") as log:
        log.solutions(made)
    pose = read(tmp_path / "a.mcap")["/pose"][-1][1]["pose"]
    there, home = made[-1], made[0]
    expected = pymap3d.geodetic2enu(
        there["lat"], there["lon"], there["height"], home["lat"], home["lon"], home["height"], deg=False
    )
    assert list(pose["position"].values()) == pytest.approx(expected, abs=1e-6)
    body = Rotation.from_quat([pose["orientation"][axis] for axis in "xyzw"])
    n_to_enu = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    q_nb = Rotation.from_quat(there["q_nb"], scalar_first=True)
    forward, right = q_nb.apply([1.0, 0.0, 0.0]), q_nb.apply([0.0, 1.0, 0.0])
    assert body.apply([1.0, 0.0, 0.0]) == pytest.approx(n_to_enu @ forward, abs=1e-12)
    assert body.apply([0.0, -1.0, 0.0]) == pytest.approx(n_to_enu @ right, abs=1e-12)


def test_a_clock_that_begins_anew_goes_on(tmp_path: Path) -> None:
    with McapLog(tmp_path / "a.mcap") as log:
        log.solutions(rows(100, start_s=1000.0))
        log.solutions(rows(100, start_s=0.0))
    assert len(read(tmp_path / "a.mcap")["/state"]) == 10


def test_a_file_without_an_end_is_read_up_to_its_last_chunk(tmp_path: Path) -> None:
    path = tmp_path / "torn.mcap"
    log = McapLog(path)
    log.solutions(rows(5000))
    log.flush()
    torn = path.read_bytes()  # what a killed process leaves
    log.close()
    whole = len(read(path)["/imu"])
    path.write_bytes(torn)
    found = []
    with path.open("rb") as file, pytest.raises(McapError):
        found.extend(NonSeekingReader(file).iter_messages(log_time_order=False))
    assert whole == 5000
    assert 0.8 * whole < sum(channel.topic == "/imu" for _, channel, _ in found) < whole


def test_nonsense_is_not_written(tmp_path: Path) -> None:
    made = rows(1)
    made["f_b"] = math.nan
    log = McapLog(tmp_path / "a.mcap")
    with pytest.raises(ValueError, match="JSON"):
        log.solutions(made)
    log.close()


def test_a_place_that_cannot_be_written_is_explained(tmp_path: Path) -> None:
    with pytest.raises(HilError, match="no/such"):
        McapLog(tmp_path / "no" / "such.mcap")
