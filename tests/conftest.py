"""What all tests share: the skip of `socketcan` tests where the kernel has no vcan0, recorded data, hypothesis profiles."""

import os
import socket
from pathlib import Path

import hypothesis
import pytest

_TESTS = Path(__file__).parent
_ALONE = {_TESTS / "e2e", _TESTS / "hil", *(_TESTS / "drivers" / wire for wire in ("can", "serial", "mavlink"))}

hypothesis.settings.register_profile("local", deadline=None)
hypothesis.settings.register_profile("ci", deadline=None, derandomize=True, print_blob=True)
hypothesis.settings.load_profile("ci" if os.environ.get("CI") else "local")


def _socketcan_lack() -> str | None:
    """What keeps this machine from real SocketCAN, with the command that mends it; None when vcan0 can be used."""
    in_guest = "or run them in user-mode Linux: tools/with_vcan.sh -- .venv/bin/python -m pytest -m socketcan"
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as probe:
            probe.bind(("vcan0",))
    except (OSError, AttributeError) as error:
        mend = "sudo modprobe vcan && sudo ip link add vcan0 type vcan && sudo ip link set vcan0 mtu 72 up"
        return f"no SocketCAN interface vcan0 here ({error}): {mend}; {in_guest}"
    return None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip the tests marked `socketcan` where they cannot run; mark those that run processes in real time."""
    for item in items:
        if item.path.parent in _ALONE:
            item.add_marker(pytest.mark.alone)
    marked = [item for item in items if item.get_closest_marker("socketcan")]
    if marked and (lack := _socketcan_lack()):
        for item in marked:
            item.add_marker(pytest.mark.skip(reason=lack))


@pytest.fixture(scope="session", autouse=True)
def own_state(tmp_path_factory: pytest.TempPathFactory) -> None:
    """What runs keep for the next one lies in a folder of the tests', for their processes too."""
    os.environ["XDG_STATE_HOME"] = str(tmp_path_factory.mktemp("state"))


@pytest.fixture(scope="session")
def hil_data() -> Path:
    """Folder of recorded logs and vendor files that are too large or not ours to keep in the repository."""
    folder = os.environ.get("HIL_DATA")
    if not folder:
        pytest.skip("HIL_DATA is not set: export HIL_DATA=DIR, the folder of the recorded logs")
    path = Path(folder)
    assert path.is_dir(), f"HIL_DATA={folder} is not a folder"
    return path
