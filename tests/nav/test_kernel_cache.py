"""Compiled kernels on disk, each time in processes of their own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

INNER = """
from typing import NamedTuple
from nav.kernel import inline_kernel
SCALE = 3.0
class Pair(NamedTuple):
    a: float
    b: float
@inline_kernel
def inner(x):
    return x + 1.0
"""
OUTER = """
from inner import SCALE, Pair, inner
from nav.kernel import kernel
@kernel
def outer(pair):
    return SCALE * inner(pair.a)
def result():
    answer = outer(Pair(a=2.0, b=10.0))
    return answer, sum(outer.stats.cache_hits.values())
print(*result())
"""
RACE = """
import sys, time
import numpy as np
import numba.core.caching as caching
save = caching.IndexDataCacheFile._save_index
def slow(self, overloads):  # the index last read is written last, the code that it names is another one's
    time.sleep(float(sys.argv[2]))
    save(self, overloads)
    time.sleep(float(sys.argv[3]))
caching.IndexDataCacheFile._save_index = slow
from first import first
value = np.array([2], sys.argv[1])
print("ready", flush=True)
sys.stdin.readline()
print(first(value), flush=True)
"""
FIRST = """
from nav.kernel import kernel
@kernel
def first(values):
    return values[0] * 3
"""


def start(folder: Path, *command: str) -> subprocess.Popen[str]:
    surroundings = os.environ | {"PYTHONPATH": f"{folder}:{ROOT}", "PYTHONDONTWRITEBYTECODE": "1"}
    surroundings.pop("NUMBA_CACHE_DIR", None)
    return subprocess.Popen(
        [sys.executable, *command],
        cwd=folder,
        env=surroundings,
        text=True,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )


def answer(folder: Path, *command: str) -> list[float]:
    process = start(folder, *command)
    said, _ = process.communicate(timeout=120)
    assert process.returncode == 0
    return [float(part) for part in said.split()]


@pytest.fixture
def modules(tmp_path: Path) -> Path:
    (tmp_path / "inner.py").write_text(INNER)
    (tmp_path / "outer.py").write_text(OUTER)
    return tmp_path


def test_compiled_once(modules: Path) -> None:
    assert answer(modules, "outer.py") == [9.0, 0]
    assert answer(modules, "outer.py") == [9.0, 1]


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("x + 1.0", "x + 2.0", 12.0),
        ("SCALE = 3.0", "SCALE = 4.0", 12.0),
        ("a: float\n    b: float", "b: float\n    a: float", 9.0),
    ],
    ids=["kernel", "constant", "fields"],
)
def test_a_change_in_another_file_is_seen(modules: Path, old: str, new: str, expected: float) -> None:
    answer(modules, "outer.py")
    (modules / "inner.py").write_text(INNER.replace(old, new))
    assert answer(modules, "outer.py") == [expected, 0]
    assert answer(modules, "outer.py") == [expected, 1]


@pytest.mark.slow
def test_two_processes_compile_two_signatures_at_once(tmp_path: Path) -> None:
    (tmp_path / "first.py").write_text(FIRST)
    (tmp_path / "race.py").write_text(RACE)
    pauses = {"int64": "2 3", "float64": "3 0"}
    processes = [start(tmp_path, "race.py", kind, *pause.split()) for kind, pause in pauses.items()]
    for process in processes:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    for process in processes:
        process.communicate(timeout=120)
    for kind in pauses:
        process = start(tmp_path, "race.py", kind, "0", "0")
        assert float(process.communicate("\n", timeout=120)[0].split()[1]) == 6.0
