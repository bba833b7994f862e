"""The pytest plugin, as the suite of another project would use it."""

import pytest

pytest_plugins = ["pytester"]


def test_bridge_runs_and_is_cleaned_up(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import os
        from pymavlink import mavutil

        started = []

        def test_talks(hil_bridge):
            bridge = hil_bridge(navigation={"alignment": "truth"}, head={"rate_hz": 200})
            started.append(bridge)
            link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{bridge.mavlink_port}")
            state = bridge.wait_mode("navigate", timeout_s=30)
            assert state["lat"] > 0.8
            assert link.recv_match(type="ATTITUDE", blocking=True, timeout=10)
            link.close()
            assert bridge.summary()["lost"] == 0

        def test_two_at_once_do_not_meet(hil_bridge):
            bridges = [hil_bridge("rest", duration_s=2, paced=False, head={"serial": n}) for n in (7, 8)]
            assert bridges[0].bus != bridges[1].bus and bridges[0].mavlink_port != bridges[1].mavlink_port
            for n, bridge in zip((7, 8), bridges):
                summary = bridge.wait_end(30)
                assert summary["samples"] == 2000 and summary["foreign"] == summary["lost"] == 0
                assert summary["head"]["serial"] == n
                assert bridge.stop() == bridge.summary()

        def test_fails_while_running(hil_bridge):
            with hil_bridge(navigation={"alignment": "truth"}) as bridge:
                bridge.wait_mode("navigate")
            started.append(hil_bridge(navigation={"alignment": "truth"}))
            started[-1].wait_mode("navigate")
            assert False, "on purpose"

        def test_nothing_is_left():
            assert len(started) == 2
            for bridge in started:
                assert all(not part.process.is_alive() for part in bridge.session._parts.values())
        """
    )
    result = pytester.runpytest_subprocess("-q")
    result.assert_outcomes(passed=3, failed=1)
    result.stdout.fnmatch_lines(["*Captured stdout teardown*", "hil default*navigating from a given start*"])


def test_own_head_on_the_bus(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import numpy as np
        from drivers.can.bus import open_port
        from drivers.can.dtg_head_emulator import HeadEncoder

        def test_it(hil_bridge, tmp_path):
            bridge = hil_bridge("rest", simulate_head=False, record=tmp_path / "own.dhil")
            encoder, port = HeadEncoder("fd", 1000, serial=77), open_port(bridge.bus, listen=False)
            counter = np.arange(100)
            port.send(encoder.slow())
            port.send(encoder.samples(counter, (counter + 1) * 1000, np.zeros((100, 4)), np.full((100, 3), -9.8e-3)))
            bridge.wait_mode("align", timeout_s=10)
            port.close()
            summary = bridge.stop()
            assert summary["samples"] == 100 and summary["head"]["serial"] == 77
            assert summary["recorder"]["frames"] >= 105 and "feeder" not in summary
            assert any("aligning" in text for _, _, text in bridge.events())
        """
    )
    pytester.runpytest_subprocess("-q").assert_outcomes(passed=1)


def test_wrong_request_is_named(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import pytest
        from nav.errors import HilError

        def test_scenario(hil_bridge):
            with pytest.raises(HilError, match="no-such.*default.*flight"):
                hil_bridge("no-such")

        def test_key(hil_bridge):
            with pytest.raises(HilError, match="navigation.align_s = 'soon'"):
                hil_bridge(navigation={"align_s": "soon"})

        def test_bus(hil_bridge):
            with pytest.raises(HilError, match="expected INTERFACE:CHANNEL"):
                hil_bridge(bus="nonsense", simulate_head=False)

        def test_mode_not_reached(hil_bridge):
            with pytest.raises(HilError, match="mode navigate was not reached"):
                hil_bridge(simulate_head=False).wait_mode("navigate", timeout_s=0.3)
        """
    )
    pytester.runpytest_subprocess("-q").assert_outcomes(passed=4)


def test_other_suites_pay_nothing(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import sys

        def test_imports(request):
            assert request.config.pluginmanager.has_plugin("dtg_hil")
            heavy = {"numba", "numpy", "pydantic", "can", "pymavlink", "hil.session", "nav.state"}
            assert not heavy & set(sys.modules)
        """
    )
    pytester.runpytest_subprocess("-q", "-p", "no:hypothesispytest").assert_outcomes(passed=1)
