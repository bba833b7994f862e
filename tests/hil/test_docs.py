"""The documents agree with the product: scenario keys, message rates, and every `hil` command line that they print."""

import json
import re
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

import pytest
import typer
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from drivers.can.aiding import aiding_database_text
from drivers.can.codec import load_database
from drivers.can.dtg_head import head_database_text
from drivers.can.integrity import protection
from drivers.mavlink.messages import KINDS
from hil.cli import app
from hil.scenario import Channel, Cone, LinkConfig, Scenario

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
DOCUMENTS = sorted([*DOCS.rglob("*.md"), *DOCS.rglob("*.yml"), ROOT / "README.md"])
NOT_COMMANDS = {"text", "json", "toml", "python", "c", "xml"}

Rows = dict[str, tuple[str, str]]


def model_rows() -> Rows:
    """Key to (default, values) of everything that a scenario may hold, as docs/scenario.md writes it."""
    rows: Rows = {}
    walk(Scenario, "", rows)
    walk(Channel, "CHANNEL.", rows)
    walk(LinkConfig, "LINK.", rows)
    return rows


def walk(model: type[BaseModel], prefix: str, rows: Rows) -> None:
    for name, field in model.model_fields.items():
        inner = model_in(field.annotation)
        if inner is None:
            rows[prefix + name] = default_of(field), values_of(field)
        elif inner is Channel:
            rows[prefix + name] = "", "a channel"
        else:
            array = get_origin(field.annotation) is tuple
            walk(inner, f"{prefix}{name}{'[]' if array else ''}.", rows)


def model_in(annotation: Any) -> type[BaseModel] | None:
    candidates = [annotation, *get_args(annotation)]
    return next((one for one in candidates if isinstance(one, type) and issubclass(one, BaseModel)), None)


def default_of(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if value is None:
        return ""
    plain = list(value) if isinstance(value, tuple) else dict(value) if isinstance(value, Mapping) else value
    return f"`{json.dumps(plain)}`"


def values_of(field: FieldInfo) -> str:
    annotation = field.annotation
    if get_origin(annotation) is Literal:
        return ", ".join(f"`{choice}`" for choice in get_args(annotation))
    bounds = {}
    metadata = list(field.metadata)
    for part in (annotation, *(get_args(annotation) if get_origin(annotation) in (Union, UnionType) else ())):
        metadata += getattr(part, "__metadata__", ())
    for item in metadata:
        for one in (item, *getattr(item, "metadata", ())):
            bounds |= {sign: getattr(one, sign) for sign in ("ge", "gt", "le", "lt") if hasattr(one, sign)}
    signs = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}
    return ", ".join(f"{signs[sign]} {number(bounds[sign])}" for sign in signs if bounds.get(sign) is not None)


def number(value: float) -> str:
    return {2**32: "2^32", 2**63: "2^63"}.get(int(value), f"{value:g}")


def table_rows(path: Path, columns: int) -> Iterator[list[str]]:
    """Rows of the tables in `path` whose first cell is a code word and that are `columns` wide."""
    for line in path.read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("| `") and len(cells) == columns:
            yield cells


def test_documented_scenario_keys_are_the_model() -> None:
    documented = {cells[0].strip("`"): (cells[1], cells[2]) for cells in table_rows(DOCS / "scenario.md", 5)}
    assert documented == model_rows()


def test_the_walk_finds_nested_keys() -> None:
    rows = model_rows()
    assert "navigation.start.heading_deg" in rows
    assert "CHANNEL.sines[].amplitude" in rows
    assert rows["motion.cone.half_angle_deg"] == ("required", ">= 0, < 90")
    assert set(Cone.model_fields) == {
        key.removeprefix("motion.cone.") for key in rows if key.startswith("motion.cone.")
    }


def test_documented_message_rates_are_the_table() -> None:
    documented = {cells[0].strip("`"): (cells[1], cells[2].strip("`")) for cells in table_rows(DOCS / "mavlink.md", 4)}
    assert documented == {name: (f"{kind.rate_hz:g}", kind.parameter) for name, kind in KINDS.items()}


def test_documented_frames_are_the_dbc() -> None:
    documented = {cells[0].strip("`"): tuple(cells[1:5]) for cells in table_rows(DOCS / "can.md", 6)}
    expected = {}
    databases = load_database(head_database_text()), load_database(aiding_database_text())
    for message in [message for database in databases for message in database.by_id.values()]:
        declared = protection(message)
        assert declared is not None
        expected[message.name] = (
            f"0x{message.can_id:X}",
            str(message.length),
            f"{declared.profile}, 0x{declared.data_id:X}",
            f"0..{declared.counter_modulus - 1}",
        )
    assert documented == expected


def fenced(path: Path) -> Iterator[str]:
    """Lines of commands in `path`, continuation lines joined."""
    text = path.read_text()
    if path.suffix == ".yml":
        yield from text.replace("\\\n", " ").splitlines()
        return
    blocks = re.findall(r"^```(\w*)\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    for kind, block in blocks:
        if kind not in NOT_COMMANDS:
            yield from block.replace("\\\n", " ").splitlines()
    outside = re.sub(r"^```\w*\n.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    yield from (line for line in outside.splitlines() if line.startswith("    "))


def inline(path: Path) -> Iterator[str]:
    """Command lines between backticks in the running text of `path`."""
    outside = re.sub(r"^```\w*\n.*?^```", "", path.read_text(), flags=re.MULTILINE | re.DOTALL)
    return (code for code in re.findall(r"`([^`\n]+)`", outside) if code.startswith("hil "))


def commands(line: str) -> Iterator[list[str]]:
    """Arguments of each call of `hil` in a shell line."""
    if "hil " not in line:
        return
    lexer = shlex.shlex(line, posix=True, punctuation_chars=True)
    lexer.whitespace_split = True
    found: list[str] | None = None
    for token in lexer:
        if re.fullmatch(r"[();<>|&]+", token):
            if found:
                if token.startswith(">") and found[-1] in {"1", "2"}:
                    found.pop()
                yield found
            found = None
        elif found is not None:
            found.append(token)
        elif token == "hil" or token.endswith("/hil"):
            found = []
    if found:
        yield found


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_command_lines_parse(path: Path) -> None:
    """Whole command lines by the real parser; those within a sentence may leave the arguments out."""
    group: Any = typer.main.get_command(app)
    alone = {option for part in group.params for option in part.opts} | {"--help"}
    for line in fenced(path):
        for arguments in commands(line):
            name, *rest = arguments
            if name in alone:
                continue
            assert name in group.commands, line
            if "--help" not in rest:
                group.commands[name].make_context(f"hil {name}", rest)
    for line in inline(path):
        for arguments in commands(line):
            if arguments[0] in alone:
                continue
            assert arguments[0] in group.commands, line
            known = {option for part in group.commands[arguments[0]].params for option in part.opts} | {"--help"}
            assert {word for word in arguments if word.startswith("--")} <= known, line


def test_the_command_parser_sees_calls() -> None:
    line = "sleep 1 && .venv/bin/hil run rest --assert 'a < 1' 2>log | tee x & hil imu # hil not this"
    assert list(commands(line)) == [["run", "rest", "--assert", "a < 1"], ["imu"]]


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(path: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", path.read_text()):
        if "://" not in target:
            assert (path.parent / target).exists(), f"{path.name}: {target}"
