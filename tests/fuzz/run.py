"""`make fuzz`: atheris on every target, one process after the other, and the outcome into docs/fuzzing.md.

    run.py [--runs N] [--seconds N] [TARGET ...]

A target runs until it has had `--runs` inputs or `--seconds` are over, in processes of `SLICE` inputs: atheris keeps a kilobyte
or two of each. What it has learnt, and inputs that fail, stay in .fuzz.
"""

import argparse
import datetime
import importlib
import re
import subprocess
import sys
import time
from inspect import isclass, isfunction
from pathlib import Path
from types import ModuleType
from typing import Any

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "fuzzing.md"
STATE = ROOT / ".fuzz"
RSS_MIB, HANG_S, LONGEST, SLICE = 2048, 25, 4096, 100_000
"""Most memory of a process, most time for one input, most bytes in one, inputs of a process."""
TRACED = ("drivers.", "hil.", "pymavlink.DFReader", "pyulog.", "can.io.", "tomllib.")
"""What is traced, by the beginnings of the modules' names; compiled functions cannot be."""
LATE = ("pymavlink.DFReader", "pyulog.core")
"""Modules that parsers import when they are called."""


def one(name: str, arguments: list[str]) -> None:
    """Fuzz one target in this process; libFuzzer ends it."""
    import atheris
    from fuzz.targets import TARGETS

    for module in LATE:
        importlib.import_module(module)
    for module in [found for known, found in sys.modules.items() if known.startswith(TRACED)]:
        _trace(atheris, module)
    target = TARGETS[name]()
    from nav.errors import HilError

    corpus = STATE / name
    corpus.mkdir(parents=True, exist_ok=True)
    for k, seed in enumerate(target.seeds):
        (corpus / f"seed-{k}").write_bytes(seed)

    def take(data: bytes) -> None:
        try:
            target.take(data)
        except HilError:
            pass

    atheris.Setup(["fuzz", *arguments, str(corpus)], take)
    atheris.Fuzz()


def _trace(atheris: Any, module: ModuleType) -> None:
    """Have the branches of a module's functions and methods noted."""
    own = [found for found in vars(module).values() if getattr(found, "__module__", "") == module.__name__]
    methods = [part for found in own if isclass(found) for part in vars(found).values()]
    for function in filter(isfunction, [*own, *methods]):
        atheris.instrument_func(function)


def watched(name: str, runs: int, seconds: int) -> tuple[int, int, str]:
    """Inputs, MiB and outcome of a target in a process of its own."""
    options = [f"-runs={runs}", f"-max_total_time={seconds}", f"-rss_limit_mb={RSS_MIB}", f"-timeout={HANG_S}"]
    options += [f"-max_len={LONGEST}", f"-artifact_prefix={STATE}/{name}-", "-print_final_stats=1"]
    command = ["nice", "-n", "19", sys.executable, __file__, "--one", name, *options]
    log = STATE / f"{name}.log"
    STATE.mkdir(exist_ok=True)
    with log.open("wb") as file:
        code = subprocess.run(command, stdout=file, stderr=subprocess.STDOUT, check=False).returncode
    text = log.read_text(errors="replace")
    done = re.findall(r"stat::number_of_executed_units: (\d+)", text) or re.findall(r"^#(\d+)\t", text, re.M) or ["0"]
    memory = re.findall(r"stat::peak_rss_mb: +(\d+)", text) or ["0"]
    return int(done[-1]), int(memory[-1]), "ok" if code == 0 else f"failed, see {log.relative_to(ROOT)}"


def whole(name: str, runs: int, seconds: int) -> str:
    """Fuzz one target, with its row of the page kept up to date; the outcome."""
    began, spent, inputs, most, outcome = time.monotonic(), 0, 0, 0, "ok"
    while outcome == "ok" and inputs < runs:
        spent = round(time.monotonic() - began)
        if seconds and spent >= seconds:
            break
        done, memory, outcome = watched(name, min(SLICE, runs - inputs), seconds and seconds - spent)
        inputs, most, spent = inputs + done, max(most, memory), round(time.monotonic() - began)
        record(name, f"| `{name}` | {datetime.date.today()} | {inputs} | {spent} | {most} | {outcome} |")
    print(f"{name:16s} {inputs:8d} inputs {spent:6d} s {most:5d} MiB  {outcome}", flush=True)
    return outcome


def record(name: str, row: str) -> None:
    """Put the row of a target into the table of the page."""
    lines = [line for line in PAGE.read_text().splitlines() if not line.startswith(f"| `{name}` |")]
    end = max(k for k, line in enumerate(lines) if line.startswith(("| `", "| ---"))) + 1
    PAGE.write_text("\n".join([*lines[:end], row, *lines[end:], ""]))


def main() -> int:
    """Run the targets that were asked for; 1 when one failed."""
    if sys.argv[1:2] == ["--one"]:
        one(sys.argv[2], sys.argv[3:])
        return 0
    parser = argparse.ArgumentParser()
    parser.add_argument("--runs", type=int, default=1_000_000)
    parser.add_argument("--seconds", type=int, default=0, help="0: no limit")
    parser.add_argument("target", nargs="*")
    order = parser.parse_args()
    from fuzz.targets import TARGETS

    unknown = sorted(set(order.target) - TARGETS.keys())
    if unknown:
        parser.error(f"no target {unknown[0]}; there is: {', '.join(TARGETS)}")
    outcomes = [whole(name, order.runs, order.seconds) for name in order.target or TARGETS]
    return int(set(outcomes) != {"ok"})


if __name__ == "__main__":
    sys.path[:0] = [str(ROOT / part) for part in ("tests", "tests/drivers/logs", "tests/drivers/serial")]
    sys.exit(main())
