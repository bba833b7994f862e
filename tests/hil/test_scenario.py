"""Scenarios: what is built in loads, what is wrong is named by key, value and expectation."""

import pytest
from pydantic import ValidationError

from hil.scenario import Scenario, built_in_names, load, parse
from nav.errors import HilError


@pytest.mark.parametrize("name", built_in_names())
def test_built_in(name):
    scenario = load(name)
    assert scenario.name == name
    assert scenario.description
    assert parse(_text(scenario), "again").motion == scenario.motion
    assert 0 < scenario.world_id() < 2**32


def _text(scenario):
    """A scenario's motion as TOML, by hand: no writer in the standard library."""

    def value(x):
        if isinstance(x, dict):
            return "{" + ", ".join(f"{k} = {value(v)}" for k, v in x.items() if v is not None) + "}"
        if isinstance(x, list):
            return "[" + ", ".join(map(value, x)) + "]"
        return f'"{x}"' if isinstance(x, str) else repr(x)

    return f"motion = {value(scenario.motion.model_dump(mode='json'))}"


def test_the_default_needs_nothing():
    assert load(None) == load("default")
    assert parse("", "empty") == Scenario()


@pytest.mark.parametrize(
    ("text", "say"),
    [
        ("speed = 3", ["speed", "= 3", "unknown key"]),
        ("[motion]\nlattitude_deg = 3", ["motion.lattitude_deg", "unknown key"]),
        ("[motion]\nlatitude_deg = 91", ["motion.latitude_deg", "91", "less than or equal to 90"]),
        ("[motion]\nlatitude_deg = nan", ["motion.latitude_deg", "nan"]),
        ("[motion]\nrest_s = 5", ["motion", "ramp_s > 0"]),
        ('[motion]\nattitude = "coordinated"', ["motion.north or motion.east"]),
        ("[head]\nrate_hz = 300", ["head.rate_hz", "300", "whole number of microseconds"]),
        ("[head]\nrate_hz = 0", ["head.rate_hz", "greater than 0"]),
        ("[head]\nmounting_deg = [1, 2]", ["head.mounting_deg"]),
        ('[head]\nlayout = "can-xl"', ["head.layout", "'can-xl'", "'fd' or 'classic'"]),
        ("[navigation]\nalign_s = 0.1", ["navigation.align_s", "0.1", "0.5"]),
        ("[navigation.start]\nheading_deg = inf", ["navigation.start.heading_deg", "inf", "finite"]),
        ("[mavlink]\nsystem_id = 0", ["mavlink.system_id", "= 0"]),
        ("[mavlink.rates_hz]\nATTITUDE = -1", ["mavlink.rates_hz.ATTITUDE", "-1"]),
        ("seed = -1", ["seed", "-1"]),
        ('motion = "fast"', ["motion", "'fast'"]),
        ("[motion", ["not TOML"]),
        ("seed = " + "9" * 5000, ["not TOML", "digits"]),
        ("seed = 0x" + "f" * 5000, ["not TOML", "digits"]),
        ("seed = " + "[" * 5000, ["not TOML", "recursion"]),
        ("name = 1\nspeed = 2", ["name", "speed"]),
    ],
)
def test_errors_name_file_key_value_and_expectation(text, say):
    with pytest.raises(HilError) as refusal:
        parse(text, "my.toml")
    assert all(part in str(refusal.value) for part in ["my.toml", *say]), str(refusal.value)


def test_files(tmp_path):
    (tmp_path / "mine.toml").write_text('name = "mine"\n')
    assert load(tmp_path / "mine.toml").name == "mine"
    for path in (tmp_path / "none.toml", tmp_path, "no-such-scenario", ""):
        with pytest.raises(HilError, match=r"one of: .*flight"):
            load(path)
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\0")
    with pytest.raises(HilError, match="not a text file"):
        load(tmp_path / "binary.toml")


def test_changes_are_laid_over_and_validated():
    base = load("flight")
    changed = base.with_changes(seed=5, head={"rate_hz": 500}, motion={"height_m": 10.0})
    assert (changed.seed, changed.head.rate_hz, changed.motion.height_m) == (5, 500.0, 10.0)
    assert changed.motion.north == base.motion.north
    assert changed.head.layout == base.head.layout
    assert base.seed == 0
    assert base.with_changes() == base
    with pytest.raises(HilError, match=r"command line: head\.rate_hz = -1"):
        base.with_changes(head={"rate_hz": -1})
    with pytest.raises(HilError, match="unknown key"):
        base.with_changes(velocity=1)
    with pytest.raises(ValidationError):
        base.seed = 3


def test_the_worlds_fingerprint_is_of_the_world_alone():
    base = load("flight")
    assert base.with_changes(bus="unix:other", navigation={"align_s": 5}).world_id() == base.world_id()
    different = [
        {"seed": 1},
        {"head": {"rate_hz": 500}},
        {"motion": {"height_m": 1.0}},
        {"head": {"mounting_deg": [1, 0, 0]}},
    ]
    assert len({base.with_changes(**change).world_id() for change in different} | {base.world_id()}) == 5


def test_an_outage_ends_after_it_starts() -> None:
    withheld = 'navigation.filter.withheld = [{ kind = "gnss", start_s = 20, end_s = 10 }]'
    with pytest.raises(HilError, match=r"withheld\.0: .*ends at 10 s, not after its start at 20 s"):
        parse(withheld, "mine.toml")
