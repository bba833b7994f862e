"""Compiled kernels on disk, each time in a process of its own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

INNER = """
from typing import NamedTuple
from numba import types
from numba.extending import intrinsic
from nav.kernel import inline_kernel
SCALE = 3.0
class Pair(NamedTuple):
    a: float
    b: float
@intrinsic
def three(context):
    def generate(context, builder, signature, arguments):
        return context.get_constant(types.int64, 3)
    return types.int64(), generate
@inline_kernel
def inner(x, y=0.0):
    return x + y + 1.0
"""
OUTER = """
from inner import SCALE, Pair, inner, three
from nav.kernel import kernel
@kernel
def outer(pair):
    return SCALE * inner(pair.a) + three()
print(outer(Pair(a=2.0, b=10.0)), sum(outer.stats.cache_hits.values()))
"""
FRESH, KEPT = 0, 1


def answer(folder: Path, *before: str) -> list[float]:
    """What the kernel gives, and how often it was found on disk."""
    surroundings = os.environ | {"PYTHONPATH": f"{folder}:{ROOT}", "PYTHONDONTWRITEBYTECODE": "1"}
    surroundings.pop("NUMBA_CACHE_DIR", None)
    command = ["bash", "-c", "; ".join([*before, f"exec {sys.executable} outer.py"])]
    done = subprocess.run(command, cwd=folder, env=surroundings, text=True, capture_output=True, check=False)
    assert done.stderr == ""
    return [float(part) for part in done.stdout.split()]


def files(folder: Path, kernel: str) -> list[Path]:
    return list((folder / "__pycache__").glob(f"{kernel}*.nbk"))


@pytest.fixture
def modules(tmp_path: Path) -> Path:
    (tmp_path / "inner.py").write_text(INNER)
    (tmp_path / "outer.py").write_text(OUTER)
    return tmp_path


@pytest.mark.slow
def test_a_kernel_is_kept(modules: Path) -> None:
    assert answer(modules) == [12.0, FRESH]
    assert answer(modules, "export PYTHONHASHSEED=5") == [12.0, KEPT]
    (modules / "outer.py").write_text(OUTER.replace("b=10.0)", "b=1)"))
    assert answer(modules) == [12.0, FRESH]
    assert len(files(modules, "outer")) == 2  # another signature, another file


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("+ 1.0", "+ 2.0", 15.0),
        ("SCALE = 3.0", "SCALE = 4.0", 15.0),
        ("a: float\n    b: float", "b: float\n    a: float", 12.0),
        ("y=0.0", "y=1.0", 15.0),
        ("types.int64, 3", "types.int64, 6", 15.0),
    ],
    ids=["kernel", "constant", "fields", "default", "intrinsic"],
)
def test_a_change_in_another_file_is_seen(modules: Path, old: str, new: str, expected: float) -> None:
    answer(modules)
    (modules / "inner.py").write_text(INNER.replace(old, new))
    assert answer(modules) == [expected, FRESH]
    assert answer(modules) == [expected, KEPT]


@pytest.mark.slow
def test_what_cannot_be_written_whole_is_not_used(modules: Path) -> None:
    answer(modules)
    (modules / "outer.py").write_text(OUTER.replace("+ three()", "- three()"))
    assert answer(modules, "ulimit -f 2") == [6.0, FRESH]  # 2 KiB a file: as on a full disk
    assert answer(modules) == [6.0, FRESH]
    (file,) = files(modules, "outer")
    for damaged in (b"", file.read_bytes()[:-100], file.read_bytes()[:-100] + bytes(100)):
        file.write_bytes(damaged)
        assert answer(modules) == [6.0, FRESH]
    assert answer(modules) == [6.0, KEPT]
    assert {path.suffix for path in (modules / "__pycache__").iterdir()} == {".nbk"}
