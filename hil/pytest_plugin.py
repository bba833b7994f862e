"""The pytest plugin ``dtg_hil``: a running sensor head and bridge for your own tests.

It comes with the package and needs no registration. The fixture `hil_bridge` is a factory; nothing is imported or started
before it is called, and what it started is ended after the test, whatever became of the test::

    def test_attitude_reaches_my_autopilot(hil_bridge):
        bridge = hil_bridge("default", navigation={"alignment": "truth"})
        link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{bridge.mavlink_port}")
        bridge.wait_mode("navigate")
        assert link.recv_match(type="ATTITUDE", blocking=True, timeout=5)
        assert bridge.stop()["lost"] == 0

Each call has a `unix:` bus and a UDP port of its own, so that tests may run side by side.
"""

import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import pytest

if TYPE_CHECKING:
    from hil.scenario import Scenario
    from hil.session import Session
    from nav.state import Mode

POLL_S = 0.02


class Bridge:
    """A bridge at work; as a context manager it ends with the block, else with the test.

    Attributes
    ----------
    session : Session
        The run behind it.
    mavlink_port : int or None
        UDP port on 127.0.0.1 that gets the MAVLink; None where the test chose links of its own.
    """

    def __init__(self, session: "Session", mavlink_port: int | None) -> None:
        self.session = session
        self.mavlink_port = mavlink_port
        self._events: list[tuple[float, str, str]] = []
        self._ended = False

    @property
    def scenario(self) -> "Scenario":
        """What is run."""
        return self.session.order.scenario

    @property
    def bus(self) -> str:
        """URL of the bus, for other participants."""
        return self.scenario.bus

    def wait_mode(self, *modes: "Mode | str", timeout_s: float = 60.0) -> Any:
        """Block until the navigator is in one of `modes` (``"navigate"``, ...); the state then.

        Raises
        ------
        HilError
            It was not in time, or the run ended before.
        """
        from nav.state import Mode

        wanted = [Mode[mode.upper()] if isinstance(mode, str) else mode for mode in modes]
        return self.session.wait_mode(*wanted, timeout_s=timeout_s)

    def wait_end(self, timeout_s: float = 600.0) -> dict[str, Any]:
        """Block until the scenario's duration is over; the complete summary.

        Raises
        ------
        HilError
            It was not over in time, or a part of the run failed.
        """
        from nav.errors import HilError

        deadline = time.monotonic() + timeout_s
        while not self._ended and self.session.running:
            if time.monotonic() > deadline:
                raise HilError(f"scenario {self.scenario.name} did not end in {timeout_s:g} s")
            time.sleep(POLL_S)
        return self.stop()

    def state(self) -> Any:
        """A copy of the newest `nav.state.NAV_STATE` row; None before the first."""
        return self.session.state()

    def events(self) -> list[tuple[float, str, str]]:
        """(device time, severity, text) of all that has happened."""
        while new := self.session.events():
            self._events += new
        return list(self._events)

    def summary(self) -> dict[str, Any]:
        """What ``hil run --json`` prints; complete after the end."""
        return self.session.summary()

    def stop(self) -> dict[str, Any]:
        """End the run and its processes; the complete summary. A second call only returns it."""
        if not self._ended:
            self._ended = True
            self.session.__exit__(None, None, None)
        return self.summary()

    def __enter__(self) -> "Bridge":
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


class StartBridge(Protocol):
    """The type of `hil_bridge`."""

    def __call__(
        self,
        scenario: "str | Path | Scenario | None" = None,
        *,
        simulate_head: bool = True,
        paced: bool = True,
        record: Path | None = None,
        realtime: bool = False,
        **changes: Any,
    ) -> Bridge: ...


@pytest.fixture
def hil_bridge() -> Iterator[StartBridge]:
    """Factory of running bridges: ``hil_bridge(scenario=None, **changes)``.

    Parameters
    ----------
    scenario : str, Path or Scenario, optional
        Built-in name, TOML file or object; left out: the embedded default.
    simulate_head : bool
        False: your own head or player feeds the bus.
    paced : bool
        Real time; False: simulated time, as fast as it goes and lossless.
    record : Path, optional
        Recording to write.
    realtime : bool
        As ``--realtime``.
    **changes
        Laid over the scenario, as ``duration_s=5`` or ``head={"rate_hz": 100}``; `bus` and ``mavlink={"links": ...}``
        replace the private ones.

    Returns
    -------
    Bridge
        Listening, its head sending.
    """
    with ExitStack() as stack:

        def start(
            scenario: "str | Path | Scenario | None" = None,
            *,
            simulate_head: bool = True,
            paced: bool = True,
            record: Path | None = None,
            realtime: bool = False,
            **changes: Any,
        ) -> Bridge:
            from drivers.can.unix_bus import remove
            from hil.bridge import LoopOrder
            from hil.scenario import Scenario, load
            from hil.session import Session, simulated_head

            chosen = scenario if isinstance(scenario, Scenario) else load(scenario)
            if "bus" not in changes:
                name = f"test-{time.monotonic_ns():x}"
                changes["bus"] = f"unix:{name}"
                stack.callback(remove, name)
            port = None
            if "links" not in changes.get("mavlink", {}):
                port = _free_udp_port()
                changes["mavlink"] = {**changes.get("mavlink", {}), "links": (f"udpout:127.0.0.1:{port}",)}
            order = LoopOrder(chosen.with_changes(**changes), paced=paced, realtime=realtime)
            session = Session(order, feeder=simulated_head(order) if simulate_head else None, record=record)
            bridge = Bridge(session.__enter__(), port)
            stack.callback(_report, bridge)
            stack.callback(bridge.stop)
            session.wait_ready()
            return bridge

        yield start


def _report(bridge: Bridge) -> None:
    """Print what happened: pytest shows it where the test failed."""
    for device_s, severity, text in bridge.events():
        print(f"hil {bridge.scenario.name} {device_s:10.3f} s  {severity}: {text}")


def _free_udp_port() -> int:
    import socket

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
