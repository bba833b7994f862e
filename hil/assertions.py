"""Assertions on the summary of a run: ``error.position_m.max < 0.5``, and their report as JUnit XML."""

import operator
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nav.errors import HilError

_OPERATORS: dict[str, Callable[[float, float], bool]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    ">": operator.gt,
}
_FORM = re.compile(r"\s*([A-Za-z_][\w.]*)\s*(<=|>=|==|!=|<|>)\s*([-+\w.]+)\s*")


@dataclass(frozen=True, slots=True)
class Assertion:
    """One assertion, parsed.

    Attributes
    ----------
    text : str
        As the user wrote it.
    path : str
        Keys into the summary, joined by dots.
    relation : str
        One of < <= > >= == !=.
    limit : float or str
        What is compared with; a word is compared as text (``mode == navigate``).
    """

    text: str
    path: str
    relation: str
    limit: float | str

    def failure(self, summary: Mapping[str, Any]) -> str | None:
        """Why it does not hold; None when it does."""
        value: Any = summary
        for key in self.path.split("."):
            if not isinstance(value, Mapping) or key not in value:
                there = ", ".join(map(str, value)) if isinstance(value, Mapping) else "no keys"
                return f"{self.text}: the summary has no {self.path} (at {key!r} there is: {there})"
            value = value[key]
        if isinstance(self.limit, str):
            holds = (str(value) == self.limit) == (self.relation == "==")
        else:
            holds = isinstance(value, int | float) and _OPERATORS[self.relation](value, self.limit)
        return None if holds else f"{self.text}: {self.path} is {value}"


def parse(text: str) -> Assertion:
    """Read ``KEY.KEY OP NUMBER``.

    Raises
    ------
    HilError
        The text has another form.
    """
    match = _FORM.fullmatch(text)
    if match is None:
        raise HilError(f"assertion {text!r}: expected KEY OP NUMBER, as in 'error.position_m.max < 0.5'")
    path, relation, limit = match.groups()
    try:
        return Assertion(text, path, relation, float(limit))
    except ValueError:
        if relation in {"==", "!="}:
            return Assertion(text, path, relation, limit)
        raise HilError(f"assertion {text!r}: {limit!r} is not a number") from None


def write_junit(path: Path, name: str, checks: Sequence[tuple[Assertion, str | None]], seconds: float) -> None:
    """Write the outcome as JUnit XML, one test case an assertion.

    Raises
    ------
    HilError
        The file cannot be written.
    """
    failures = sum(1 for _, failure in checks if failure)
    suite = ET.Element(
        "testsuite", name=f"hil {name}", tests=str(len(checks)), failures=str(failures), time=f"{seconds:.3f}"
    )
    for assertion, failure in checks:
        case = ET.SubElement(suite, "testcase", classname=f"hil.{name}", name=assertion.text)
        if failure:
            ET.SubElement(case, "failure", message=failure)
    try:
        ET.ElementTree(suite).write(path, encoding="utf-8", xml_declaration=True)
    except OSError as error:
        raise HilError(f"junit {path}: {error.strerror}") from error
