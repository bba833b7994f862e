"""The version of this software as MAVLink tells it."""

from functools import cache
from importlib.metadata import PackageNotFoundError, version


@cache
def software_version() -> str:
    """As text; empty where it is not installed."""
    try:
        return version("dtg-hil")
    except PackageNotFoundError:
        return ""


def version_number() -> int:
    """As AUTOPILOT_VERSION encodes it: major, minor, patch, type (0: development)."""
    parts = [int(part) if part.isdigit() else 0 for part in software_version().split(".")[:3]]
    major, minor, patch = (*parts, 0, 0, 0)[:3]
    return (major & 255) << 24 | (minor & 255) << 16 | (patch & 255) << 8
