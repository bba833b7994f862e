"""Mechanizations and attitude methods by name, as a user chooses them."""

from nav.errors import HilError

ATTITUDE_METHODS = ("two-sample",)
MECHANIZATIONS = ("geographic",)


def check_choice(attitude: str, mechanization: str) -> None:
    """Refuse an unknown choice by name.

    Raises
    ------
    HilError
        Names the choice and what there is.
    """
    for what, choice, known in (
        ("attitude method", attitude, ATTITUDE_METHODS),
        ("mechanization", mechanization, MECHANIZATIONS),
    ):
        if choice not in known:
            raise HilError(f"unknown {what} {choice!r}; there is: {', '.join(known)}")
