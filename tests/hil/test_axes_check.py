"""How a board stands in the vehicle: said in three ways, found by `hil check-axes`, told where gravity is along a wrong axis."""

import json
import math
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from beside import beside
from commands import hil
from postures import RATE_HZ, SEQUENCE, increments, through
from scipy.spatial.transform import Rotation

from drivers import make_emulator
from drivers.can.bus import open_port
from drivers.can.frames import FrameArray
from drivers.logs.recording import RecordingWriter
from hil.bridge import Loop, LoopOrder, Outlets
from hil.scenario import HeadConfig, Scenario, load
from hil.world.head import SimulatedHead
from hil.world.instruments import mounting
from nav.alignment.axes import SIGNED, matrix
from nav.alignment.postures import ORDERS
from nav.increments import ImuIncrements

FLIP_Y = np.diag([1.0, -1.0, 1.0])


def by_board(imu: ImuIncrements, gyro: Any, accelerometer: Any) -> FrameArray:
    """Frames of an SBG board whose axes are those of the body turned back by these."""
    turned = ImuIncrements.empty(len(imu))
    turned.fill(imu)
    turned.dtheta[:], turned.dvel[:] = imu.dtheta @ gyro, imu.dvel @ accelerometer
    emulator = make_emulator("sbg", 1_000_000 // RATE_HZ)
    return np.concatenate([emulator.slow(), emulator.samples(turned)])


def recording(path: Path, batch: FrameArray) -> Path:
    writer = RecordingWriter(path, {"scenario": load(None).with_changes(driver="sbg").model_dump(mode="json")})
    writer.write(batch)
    writer.close()
    return path


def checked(path: Path, *more: object, code: int = 0) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(hil("check-axes", path, *more, "--json", code=code)[0])
    return found


@pytest.mark.parametrize("axes", [("x", "y", "z"), ("y", "x", "-z"), ("-z", "x", "-y"), ("-x", "-y", "z")])
def test_the_line_for_the_scenario_is_found(tmp_path: Path, axes: tuple[str, ...]) -> None:
    turn = matrix(axes)
    path = recording(tmp_path / "turned.dhil", by_board(through(SEQUENCE), turn, turn))
    found = checked(path)
    assert found["rests"] == len(ORDERS)
    assert found["head_axes"] == list(axes)
    assert found["head_mounting"] is None
    assert found["motion"]["says"] == "as they should be", "gyros and accelerometers agree"
    assert f"head.axes = {json.dumps(list(axes))}" in hil("check-axes", path)[0]
    assert HeadConfig(axes=found["head_axes"]).axes == axes


@pytest.mark.parametrize(
    ("gyro", "accelerometer", "said", "gyro_says", "accelerometer_says"),
    [
        (FLIP_Y, np.eye(3), "the gyros are left-handed", "the sign of y is reversed", "as they should be"),
        (np.eye(3), FLIP_Y, "the accelerometers are left-handed", "as they should be", "the sign of y is reversed"),
        (matrix(("y", "x", "-z")), np.eye(3), "both are right-handed", "x and y are swapped, the sign of z", "as they"),
        (-np.eye(3), -np.eye(3), "are left-handed, which no mounting mends", "the sign of x and y and z", "the sign"),
    ],
)
def test_what_no_mounting_mends_is_named(
    tmp_path: Path, gyro: Any, accelerometer: Any, said: str, gyro_says: str, accelerometer_says: str
) -> None:
    found = checked(recording(tmp_path / "wrong.dhil", by_board(through(SEQUENCE), gyro, accelerometer)), code=1)
    assert said in found["verdict"]
    assert found["gyro"]["says"].startswith(gyro_says)
    assert found["accelerometer"]["says"].startswith(accelerometer_says)
    assert found["head_axes"] is None


def test_a_board_that_stands_askew_gets_a_matrix(tmp_path: Path) -> None:
    """The sequence is of the vehicle; the board in it is turned by 25 deg: the matrix puts it right to a degree."""
    turn = Rotation.from_euler("ZYX", [25, 5, -8], degrees=True).as_matrix()
    found = checked(recording(tmp_path / "askew.dhil", by_board(through(SEQUENCE), turn, turn)))
    off = Rotation.from_matrix(mounting(HeadConfig(mounting=found["head_mounting"])) @ turn.T).magnitude()
    assert math.degrees(off) < 1.0


def test_a_wrong_unit_is_not_taken_for_axes(tmp_path: Path) -> None:
    """Forces in g: the axes are right all the same. Rates in degrees: no axes fit."""
    found = checked(recording(tmp_path / "g.dhil", by_board(through(SEQUENCE), np.eye(3), np.eye(3) / 9.80665)))
    assert found["head_axes"] == ["x", "y", "z"]
    assert "specific force at rest is 0.102 g: is its unit m/s^2?" in found["verdict"]
    short = checked(recording(tmp_path / "w.dhil", by_board(through(SEQUENCE), np.eye(3) / 9, np.eye(3))), code=1)
    assert (
        "do not feel a turn that the accelerometers show" in short["verdict"] or "rests were found" in short["verdict"]
    )


def test_a_dtg_head_whatever_its_mounting_in_the_scenario(tmp_path: Path) -> None:
    """Its own axes are looked at, those of the four gyro axes combined."""
    swings = {name: {"sines": [{"amplitude": 40, "period_s": s}]} for name, s in (("heading", 3), ("pitch", 4))}
    chosen = standing(axes=("y", "x", "-z"), lever_arm_m=(0, 0, 0)).with_changes(
        motion={"rest_s": 0, "ramp_s": 0, **swings}
    )
    path = tmp_path / "head.dhil"
    writer = RecordingWriter(path, {"scenario": chosen.model_dump(mode="json")})
    for _, *parts in SimulatedHead(chosen).chunks(1200):
        for part in parts:
            writer.write(part)
    writer.close()
    found = checked(path)
    assert found["motion"]["says"] == "as they should be"
    assert found["motion"]["certain"]
    assert found["motion"]["off_deg"] < 5.0


def test_motion_alone_tells_whether_gyros_and_accelerometers_agree(tmp_path: Path) -> None:
    t = np.arange(15 * RATE_HZ) / RATE_HZ
    waved = increments(Rotation.from_euler("ZYX", np.sin(t[:, None] * [1.3, 1.7, 2.3]) * [0.8, 0.9, 1.0]))
    good = checked(recording(tmp_path / "good.dhil", by_board(waved, SIGNED[7], SIGNED[7])))
    assert good["verdict"].startswith("gyros and accelerometers lie alike;")
    assert good["head_axes"] is None
    bad = checked(recording(tmp_path / "bad.dhil", by_board(waved, FLIP_Y, np.eye(3))), code=1)
    assert bad["verdict"].endswith("the gyros against the accelerometers: the sign of y is reversed")
    still = checked(recording(tmp_path / "rest.dhil", by_board(through(SEQUENCE[:1]), np.eye(3), np.eye(3))), code=1)
    assert "1 rests were found" in still["verdict"]
    assert "gravity turned too little" in still["verdict"]


def test_a_user_is_led_through_the_sequence(monkeypatch: pytest.MonkeyPatch) -> None:
    """A board that does as it is told, ten times as fast as a hand."""
    url, turn = f"unix:axes-{time.monotonic_ns():x}", matrix(("-y", "x", "z"))
    batch = by_board(through(SEQUENCE), turn, turn)

    def feed(ended: threading.Event) -> None:
        port = open_port(url, listen=False)
        try:
            while port.listeners == 0 and not ended.wait(0.01):  # type: ignore[attr-defined]
                pass
            for start in range(0, len(batch), 32):
                port.send(batch[start : start + 32].copy())
                if ended.wait(0.008):
                    return
        finally:
            port.close()

    with beside(feed):
        out, err = hil("check-axes", "--bus", url, "--imu", "sbg", "--json")
    assert json.loads(out)["head_axes"] == ["-y", "x", "z"]
    told = [line for line in err.splitlines() if " of 6: " in line]
    assert [line[:6] for line in told] == [f"{k} of 6" for k in range(1, 7)]
    assert "raise its nose" in told[1]


def test_requests_that_cannot_be_met(tmp_path: Path) -> None:
    assert "give a recording, or --bus" in hil("check-axes", code=2)[1]
    assert "--imu is missing" in hil("check-axes", "--bus", "unix:none", code=2)[1]
    monkey = tmp_path / "x.log"
    monkey.write_text("(1.0) can0 123#00\n")
    assert "give the driver with --imu" in hil("check-axes", monkey, code=2)[1]
    assert f"{monkey}: no samples of sbg in it" in hil("check-axes", monkey, "--imu", "sbg", code=2)[1]


def test_nobody_is_asked_for_a_posture_before_a_sample_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hil.axes_check.MUTE_S", 0.3)
    said = hil("check-axes", "--bus", f"unix:axes-{time.monotonic_ns():x}", "--imu", "sbg", code=1)[1]
    assert "no samples in 0.3 s: hil monitor shows what comes" in said
    assert "1 of 6" not in said


def standing(**head: Any) -> Scenario:
    return Scenario.model_validate(
        {
            "bus": "unix:none",
            "duration_s": 12.0,
            "head": {"rate_hz": 100, "lever_arm_m": (0.4, -0.3, 0.2), **head},
            "motion": {
                "rest_s": 4,
                "ramp_s": 2,
                "heading": {"rate": 5.0},
                "roll": {"sines": [{"amplitude": 20, "period_s": 5}]},
            },
            "navigation": {"alignment": "level", "align_s": 2.0, "start": {"heading_deg": 0.0}},
        }
    )


def run(chosen: Scenario, sent_by: Scenario | None = None) -> tuple[dict[str, Any], list[str]]:
    """The result and the texts of a loop that takes the frames of a simulated head."""
    outlets = Outlets.make(recording=False, readers=1)
    loop = Loop(LoopOrder(chosen, paced=False, own_world=True), outlets)
    for _, *parts in SimulatedHead(sent_by or chosen).chunks(1200):
        for part in parts:
            loop.take(part)
    rows = np.zeros(64, outlets.events.dtype)
    copied, _ = outlets.events.pull(rows, 0)
    return loop.result(), [row["text"].decode() for row in rows[:copied]]


@pytest.mark.parametrize("driver", ["dtg-head", "xsens-can"])
def test_three_ways_to_say_one_mounting(driver: str) -> None:
    """Simulated board and core read it alike, and the vehicle moves as if the board stood straight."""
    ways: list[dict[str, Any]] = [
        {},
        {"axes": ("y", "x", "-z")},
        {"mounting": ((0, 1, 0), (1, 0, 0), (0, 0, -1))},
        {"mounting_deg": (90, 0, 180)},
    ]
    straight, *turned = [mounting(HeadConfig(**way)) for way in ways]
    np.testing.assert_array_equal(straight, np.eye(3))
    for one in turned:
        np.testing.assert_allclose(one, turned[0], atol=1e-15)
    limit = 1e-3 if driver == "dtg-head" else 1.0  # an Xsens rounds rates to 0.1 deg/s
    for way in ways:
        result, _ = run(standing(**way).with_changes(driver=driver))
        assert result["mode"] == "navigate"
        assert result["error"]["attitude_deg"]["max"] < limit, way


@pytest.mark.parametrize(
    ("axes", "said"),
    [
        (("-z", "y", "x"), "x and z look swapped"),
        (("z", "y", "-x"), "x and z look swapped"),
        (("x", "z", "-y"), "y and z look swapped"),
        (("x", "-y", "-z"), "the sign of z looks wrong"),
    ],
)
def test_gravity_along_a_wrong_axis_is_told_at_the_alignment(axes: tuple[str, ...], said: str) -> None:
    """The board is mounted so, and the scenario does not say it."""
    turned = standing(axes=axes)
    result, texts = run(standing(), turned)
    told = [text for text in texts if "look" in text]
    assert len(told) == 1, "once, and not with every average"
    assert said in told[0]
    assert "head.axes" in told[0]
    assert len(told[0].encode()) < 240, "a longer one would be cut"
    assert result["mode"] == "navigate", "a vehicle may stand so"
    assert not any("look" in text for text in run(turned)[1])


def test_a_mounting_is_said_once(tmp_path: Path) -> None:
    file = tmp_path / "twice.toml"
    for text, said in (
        ('axes = ["y", "x", "-z"]\nmounting_deg = [1, 0, 0]', "give one of them"),
        ('axes = ["y", "x", "z"]', "left-handed"),
        ('axes = ["y", "x", "w"]', "head.axes.2 = 'w'"),
        ("mounting = [[1, 0, 0], [0, 1, 0], [0, 0.1, 1]]", "head.mounting"),
        ("mounting = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]", "left-handed"),
    ):
        file.write_text(f"[head]\n{text}\n")
        assert said in hil("run", file, code=2)[1]
