"""The command line: what is refused and how, exit codes, what stands on which stream."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from importlib.metadata import version as installed
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from commands import called

from drivers.can.convert import to_message
from drivers.can.dtg_head_emulator import HeadEncoder
from drivers.can.frames import FrameArray
from drivers.logs.recording import RecordingWriter
from drivers.mavlink.commands import autopilot_version
from hil.control import ENDINGS

Cli = Callable[..., tuple[int, str, str]]
HIL = (sys.executable, "-c", "from hil.cli import main; main()")
COMMANDS = (
    "run",
    "imu",
    "replay",
    "navigate",
    "decode",
    "record",
    "monitor",
    "check-axes",
    "calibrate",
    "configure",
    "doctor",
    "bench",
    "version",
)


@pytest.fixture
def hil() -> Cli:
    """``hil ARGUMENT...`` in this process: (exit code, standard output, standard error)."""
    return called


def a_head(samples: int) -> FrameArray:
    """Slow frames and samples of a head at rest."""
    encoder, counter = HeadEncoder("fd", 1000, serial=5), np.arange(samples)
    data = encoder.samples(
        counter, (counter + 1) * 1000, np.zeros((samples, 4)), np.full((samples, 3), (0, 0, -9.8e-3))
    )
    frames: FrameArray = np.concatenate([encoder.slow(), data])
    frames["time_ns"] = 1_700_000_000_000_000_000 + np.arange(len(frames)) * 1_000_000
    return frames


def write_candump(path: Path, frames: FrameArray) -> Path:
    import can

    with can.CanutilsLogWriter(path) as log:
        for row in frames:
            log.on_message_received(to_message(row, "can0"))
    return path


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_on_every_level(hil: Cli, command: str) -> None:
    code, out, err = hil(*command.split(), "--help")
    assert code == 0
    assert "Usage" in out
    assert not err
    if not command:
        assert all(name in out for name in COMMANDS)


def test_commands_start_fast() -> None:
    """Help and wrong requests do not pay for numba."""
    code = "import sys, hil.cli; print([m for m in ('numba', 'numpy', 'can', 'pydantic', 'pymavlink') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


@pytest.mark.parametrize(
    ("bus", "mend"),
    [
        ("socketcan:", "expected INTERFACE:CHANNEL, as unix:dtg-hil or socketcan:vcan0"),
        ("nonsense:x", "nobody knows an interface 'nonsense'; there is: "),
        ("serial:", "expected INTERFACE:CHANNEL"),
        ("serial:/dev/ttyUSB0", "expected serial:/dev/NAME:BAUD"),
        ("serial:/dev/ttyUSB0:fast", "baud rate 'fast' is not a whole number"),
        ("unix:a/b", "a bus name has 1 to 40 letters"),
        ("socketcan:can0?filter=9", "expected ID:MASK"),
        ("mavlink:pigeon:1:2", "unknown kind 'pigeon'"),
        ("mavlink:udpin:127.0.0.1:70000", "port '70000' is not a whole number"),
    ],
)
@pytest.mark.parametrize("command", ["run", "run FILE", "imu", "replay"])
def test_a_malformed_bus_is_refused_before_anything_is_started(
    hil: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, bus: str, mend: str
) -> None:
    """No kernel is prepared, no window opened, no process started: each of them would have said or left something."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").write_text(f'bus = "{bus}"\n')
    log, before = write_candump(tmp_path / "head.log", a_head(10)), set(os.listdir(tmp_path))
    given = {"run FILE": ["run", "mine.toml"], "replay": ["replay", log, "--bus", bus]}
    children = multiprocessing.active_children()
    code, out, err = hil(*given.get(command, [command, "--bus", bus]))
    assert (code, out) == (2, "")
    assert mend in err
    assert len(err.splitlines()) == 1, "nothing was said but the mend"
    assert multiprocessing.active_children() == children
    assert set(os.listdir(tmp_path)) == before


BAD_TOML = "[navigation\nalign_s = 3"


@pytest.mark.parametrize(
    ("arguments", "toml", "says"),
    [
        (["run", "FILE"], "[navigation]\nalign = 15", "navigation.align = 15: unknown key"),
        (["run", "FILE"], '[head]\nrate_hz = "fast"', "head.rate_hz = 'fast'"),
        (
            ["run", "FILE"],
            "[head]\nrate_hz = 700",
            "head.rate_hz = 700: Value error, the sample period must be a whole number",
        ),
        (["run", "FILE"], "[motion]\nrest_s = 5", "rest_s > 0 needs ramp_s > 0"),
        (["run", "FILE"], BAD_TOML, "not TOML"),
        (["run", "FILE"], "\xff\xfe", "not a text file"),
        (
            ["imu", "no-such"],
            "",
            "scenario no-such: No such file or directory; give a TOML file or one of: aided, airstart, coning, default",
        ),
        (["run", "--speed", "3"], "", "--speed 3: expected 1 or max"),
        (["run", "--speed", "max", "--bus", "unix:a"], "", "--speed max needs the simulated head of `hil run`"),
        (["run", "--assert", "fast"], "", "expected KEY OP NUMBER"),
        (["run", "--assert", "lost < few"], "", "'few' is not a number"),
        (["run", "--junit", "x.xml"], "", "--junit needs at least one --assert"),
        (["run", "--seed", "-1"], "", "--seed"),
        (["run", "--duration", "0"], "", "duration_s = 0.0"),
        (["run", "--imu", "no-board"], "", "no driver 'no-board'; there is: dronecan-imu, dtg-head"),
        (["run", "--bus", "can0"], "", "bus 'can0': expected INTERFACE:CHANNEL"),
        (["run", "--bus", "unix:a b"], "", "a bus name has 1 to 40 letters"),
        (
            ["run", "--bus", "carrier-pigeon:1"],
            "",
            "bus 'carrier-pigeon:1': nobody knows an interface 'carrier-pigeon'; there is",
        ),
        (["run", "--mavlink", "pigeon:14550"], "", "pigeon:14550"),
        (["imu", "--bus", "can0"], "", "bus 'can0': expected INTERFACE:CHANNEL"),
        (["replay", "FILE.dhil"], "", "recording FILE.dhil: No such file or directory"),
        (["record", "--bus", "unix:t-cli", "x.pcap"], "", "endings: .dhil, .log (candump), .blf, .asc"),
        (["decode", "dtg-head", "no.log"], "", "recording no.log: No such file or directory"),
        (["decode", "no-board", "no.log"], "", "no driver 'no-board'"),
        (["navigate", "no.csv", "--init", "no.toml", "--out", "x.csv"], "", "no.csv"),
        (
            ["navigate", "no.csv", "--init", "no.toml", "--out", "x.csv", "--gravity", "moon"],
            "",
            "unknown gravity 'moon'",
        ),
        (["navigate", "no.csv", "--init", "no.toml", "--out", "x.csv", "--attitude", "guess"], "", "guess"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_wrong_request_is_one_line_and_exit_2(
    hil: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], toml: str, says: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").write_bytes(toml.encode("latin-1"))
    code, out, err = hil(*("mine.toml" if argument == "FILE" else argument for argument in arguments))
    assert code == 2
    assert out == ""
    assert says in " ".join(err.replace("│", " ").split())
    assert "Traceback" not in err
    assert len([line for line in err.splitlines() if line.startswith("hil: ")]) == (0 if "Usage" in err else 1)


def test_several_wrong_keys_are_all_named(hil: Cli, tmp_path: Path) -> None:
    file = tmp_path / "two.toml"
    file.write_text('nam = "x"\n[navigation]\nalign_s = 0\n[mavlink]\nsystem_id = 300\n')
    code, _, err = hil("run", file)
    assert code == 2
    lines = err.splitlines()
    assert len(lines) == 3
    assert all(line.startswith(f"hil: scenario {file}: ") for line in lines)
    assert any("nam = 'x': unknown key" in line for line in lines)


def test_port_in_use_is_named(hil: Cli) -> None:
    import socket

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        url = f"udpin:127.0.0.1:{taken.getsockname()[1]}"
        code, out, err = hil("run", "--duration", "1", "--mavlink", url)
    assert code == 2
    assert out == ""
    assert url in err
    assert "in use" in err.lower()


def test_json_of_a_run_is_one_object_and_nothing_else(hil: Cli) -> None:
    code, out, err = hil("run", "rest", "--speed", "max", "--duration", "12", "--mavlink", "none", "--json")
    assert code == 0
    assert out.count("\n") == 1
    summary: dict[str, Any] = json.loads(out)
    assert summary["samples"] == 12000
    assert summary["lost"] == 0
    numbers = {"samples", "lost", "duplicated", "crc_errors", "late", "rate_hz"}
    assert numbers <= {key for key, value in summary.items() if isinstance(value, int | float)}
    assert set(summary["latency_us"]) == {"p50", "p99", "p999", "max"}
    assert isinstance(summary["mavlink_sent"], dict)
    assert "aligning" in err, "events go to standard error"
    assert "\x1b" not in err, "no colours where there is no terminal"


def test_summary_for_people(hil: Cli) -> None:
    code, out, _ = hil("run", "rest", "--speed", "max", "--duration", "70", "--mavlink", "none")
    assert code == 0
    for text in (
        "mode at the end",
        "navigate",
        "70000 in 70.000 s (1000.0 Hz)",
        "error against the simulated truth",
        "position_m",
    ):
        assert text in out


def test_assertions_decide_the_exit_code(hil: Cli, tmp_path: Path) -> None:
    junit = tmp_path / "hil.xml"
    wanted = ["lost == 0", "samples > 1e6", "no.such < 1", "mode == align"]
    arguments = [part for text in wanted for part in ("--assert", text)]
    code, out, err = hil(
        *("run", "rest", "--speed", "max", "--duration", "2", "--mavlink", "none", "--json", "--junit", junit),
        *arguments,
    )
    assert code == 1
    assert json.loads(out)["samples"] == 2000
    said = [line for line in err.splitlines() if line.startswith("hil: ")]
    assert said[0] == "hil: assertion failed: samples > 1e6: samples is 2000"
    assert said[1].startswith("hil: assertion failed: no.such < 1: the summary has no no.such")
    assert len(said) == 2
    suite = ET.parse(junit).getroot()
    assert (suite.get("tests"), suite.get("failures")) == ("4", "2")
    failed = [case.get("name") for case in suite if case.find("failure") is not None]
    assert failed == ["samples > 1e6", "no.such < 1"]


def test_assertions_that_hold(hil: Cli) -> None:
    code, _, err = hil("run", "--speed", "max", "--duration", "1", "--mavlink", "none", "--assert", "samples == 1000")
    assert code == 0
    assert "assertion" not in err


def test_failed_assertion_while_the_request_was_right_is_not_exit_2(hil: Cli, tmp_path: Path) -> None:
    """Junit into a folder that is not there is a wrong request, said before the run where it can be."""
    code, _, err = hil(
        *("run", "--speed", "max", "--duration", "1", "--mavlink", "none", "--assert", "lost == 0"),
        *("--junit", tmp_path / "no" / "x.xml"),
    )
    assert code == 2
    assert "x.xml: No such file or directory" in err


def test_decode(hil: Cli, tmp_path: Path) -> None:
    log = write_candump(tmp_path / "head.log", a_head(50))
    code, out, err = hil("decode", "dtg-head", log)
    lines = [json.loads(line) for line in out.splitlines()]
    assert code == 0
    assert len(lines) == 50
    assert lines[3]["sequence"] == 3
    assert lines[3]["time"] == pytest.approx(0.004)
    assert lines[3]["dvel"][2] == pytest.approx(-9.8e-3, abs=2**-26)
    assert len(lines[3]["dtheta"]) == 4
    assert lines[3]["rotor"] == [None] * 4
    counters = json.loads(err)
    assert counters["samples"] == 50
    assert counters["frames"] == 55
    assert counters["crc_errors"] == 0


def test_decode_of_a_damaged_file_uses_the_good_part(hil: Cli, tmp_path: Path) -> None:
    log = write_candump(tmp_path / "head.log", a_head(50))
    text = log.read_text().splitlines()
    log.write_text("\n".join([*text[:30], "(not a frame) at all", *text[30:]]))
    code, out, err = hil("decode", "dtg-head", log)
    assert code == 1
    assert len(out.splitlines()) == 25
    assert "unreadable after frame 30" in err
    assert "Traceback" not in err


def test_decode_into_a_closed_pipe(tmp_path: Path) -> None:
    log = write_candump(tmp_path / "head.log", a_head(3000))
    command = [*HIL, "decode", "dtg-head", str(log)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout
        assert process.stderr
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == ""


@pytest.mark.parametrize(
    "ending", [".dhil", *(pytest.param(e, marks=pytest.mark.slow) for e in (".log", ".blf", ".asc"))]
)
def test_record_writes_what_was_on_the_bus(hil: Cli, tmp_path: Path, ending: str) -> None:
    file, bus = tmp_path / f"bus{ending}", f"unix:t-record{ending}"
    head = subprocess.Popen(
        [*HIL, "imu", "--bus", bus, "--duration", "1", "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert head.stderr
    head.stderr.readline()  # it says what it is before it computes
    code, out, _ = hil("record", "--bus", bus, "--duration", "2.5", file, "--json")
    sent = json.loads(head.communicate()[0])
    assert code == 0
    assert json.loads(out)["frames"] == sent["sent"] + 5
    assert sent == {"scenario": "default", "sent": 1000, "dropped": 0}
    code, out, err = hil("decode", "dtg-head", file)
    assert code == 0
    assert len(out.splitlines()) == 1000
    assert json.loads(err)["crc_errors"] == 0


def test_doctor(hil: Cli) -> None:
    code, out, err = hil("doctor", "--json")
    assert code == 0
    assert not err
    findings = json.loads(out)["findings"]
    assert {"ok", "lack", "info"} >= {finding["verdict"] for finding in findings}
    assert all(finding["mend"] for finding in findings if finding["verdict"] == "lack")
    assert any("CAN" in finding["what"] for finding in findings)


@pytest.mark.parametrize("asked", ["--version", "version"])
def test_the_version_is_that_of_the_package_and_of_autopilot_version(hil: Cli, asked: str) -> None:
    code, out, err = hil(asked)
    assert (code, err) == (0, "")
    name, version, _, number = out.replace(")", "").split()
    assert (name, version) == ("dtg-hil", installed("dtg-hil"))
    assert int(number, 16) == autopilot_version().flight_sw_version
    assert [int(number, 16) >> shift & 255 for shift in (24, 16, 8)] == [int(part) for part in version.split(".")[:3]]


@pytest.fixture
def room() -> Iterator[Path]:
    """A folder with a path short enough for sockets."""
    with TemporaryDirectory() as folder:
        yield Path(folder)


def slow(value: Any) -> Any:
    return pytest.param(value, marks=pytest.mark.slow)


@pytest.mark.parametrize("number", [signal.SIGINT, *(slow(one) for one in sorted(ENDINGS - {signal.SIGINT}))])
def test_stop_signal_ends_with_the_summary(number: int, room: Path) -> None:
    """Sent to all processes of the run, as a terminal, `timeout` and service managers do."""
    command = [*HIL, "run", "--mavlink", "none", "--json"]
    own = {**os.environ, "NO_COLOR": "1", "XDG_RUNTIME_DIR": str(room)}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=own, start_new_session=True
    ) as process:
        assert process.stderr
        for line in process.stderr:
            if "aligning" in line:
                break
        os.killpg(process.pid, number)
        out, err = process.communicate(timeout=30)
    assert process.returncode == 0, err
    summary = json.loads(out)
    assert summary["samples"] > 0
    assert "problems" not in summary
    assert list(room.glob("*/*")) == [], "nothing is left of the private bus"


@pytest.mark.slow
def test_a_run_is_stopped_while_it_compiles(tmp_path: Path) -> None:
    own = {**os.environ, "NO_COLOR": "1", "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [*HIL, "run", "--mavlink", "none", "--no-dashboard", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=own) as process:
        assert process.stderr
        for line in process.stderr:
            if "preparing" in line:
                break
        time.sleep(3.0)
        process.send_signal(signal.SIGTERM)
        stopped = time.monotonic()
        out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert json.loads(out)["samples"] == 0
    assert time.monotonic() - stopped < 30.0  # to compile all takes a minute


def test_what_is_read_is_not_written_over(hil: Cli, tmp_path: Path) -> None:
    path = tmp_path / "a.dhil"
    with RecordingWriter(path, {}):
        pass
    (tmp_path / "b.dhil").symlink_to(path)
    before = path.read_bytes()
    for option in ("--record", "--mcap", "--smooth"):
        code, out, err = hil("replay", path, option, tmp_path / "b.dhil", "--speed", "max")
        assert (code, out) == (2, "")
        assert f"{tmp_path / 'b.dhil'} is what is read: give another file to write" in err
    assert path.read_bytes() == before


def test_an_unknown_study_is_refused_before_the_first_runs(hil: Cli) -> None:
    code, out, err = hil("study", "orientation", "nonsense")
    assert (code, out) == (2, "")
    assert "unknown study 'nonsense'; there is: all, orientation" in err
