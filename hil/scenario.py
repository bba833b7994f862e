"""A scenario: everything that a user chooses for a run, read from TOML and validated.

Errors name the file, the key, the value and what was expected. The models are frozen; options of the command line are
laid over the file with `Scenario.with_changes`.
"""

import json
import zlib
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator, model_validator

from hil.feed.config import FeedConfig
from hil.toml import parse_toml
from hil.wire_config import WireFault
from nav.alignment.axes import matrix, rotation
from nav.errors import HilError

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Vector = tuple[Finite, Finite, Finite]
PositiveVector = tuple[Positive, Positive, Positive]
AxisName = Literal["x", "y", "z", "-x", "-y", "-z"]


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Sine(_Model):
    """One sinusoid of a motion channel: amplitude * sin(2 pi tau / period + phase)."""

    amplitude: Finite
    period_s: Positive
    phase_deg: Finite = 0.0


class Channel(_Model):
    """A motion channel over the motion's own time tau: offset + rate * tau + sum of sinusoids."""

    offset: Finite = 0.0
    rate: Finite = 0.0
    sines: tuple[Sine, ...] = ()


class Cone(_Model):
    """Coning: the body's x axis is held, the rotation vector of fixed length turns in the body's y-z plane."""

    half_angle_deg: Annotated[float, Field(ge=0, lt=90)]
    frequency_hz: Finite


class MotionConfig(_Model):
    """Analytic motion of the vehicle.

    The motion runs on its own time tau(t): tau = 0 while the vehicle stands for `rest_s`, then tau speeds up smoothly over
    `ramp_s` until it runs with t. Path channels are metres north, east and up of the start; angle channels are degrees.
    With ``attitude = "coordinated"`` heading and pitch follow the path and roll balances the turn; the angle channels are
    added to that.
    """

    latitude_deg: Annotated[float, Field(ge=-90, le=90)] = 50.0
    longitude_deg: Annotated[float, Field(ge=-180, le=180)] = 36.25
    height_m: Finite = 150.0
    rest_s: NotNegative = 0.0
    ramp_s: NotNegative = 0.0
    attitude: Literal["free", "coordinated"] = "free"
    north: Channel = Channel()
    east: Channel = Channel()
    up: Channel = Channel()
    heading: Channel = Channel()
    pitch: Channel = Channel()
    roll: Channel = Channel()
    cone: Cone | None = None

    @model_validator(mode="after")
    def _consistent(self) -> "MotionConfig":
        if self.rest_s > 0 and self.ramp_s == 0:
            raise ValueError("rest_s > 0 needs ramp_s > 0: the vehicle cannot jump from rest into motion")
        if self.attitude == "coordinated" and self.north == Channel() == self.east:
            raise ValueError('attitude = "coordinated" needs a path: give motion.north or motion.east')
        return self


class RotorConfig(_Model):
    """Rotor of a dynamically tuned gyro, by the ratios that fix its motion (:mod:`nav.instruments.dtg`)."""

    spin_hz: Positive = 228.0
    inertia_ratio: Positive = 4.0 / 3.0
    """Polar over equatorial inertia, J/A."""
    stiffness_ratio: Positive = 10694.0
    """Cross-axis stiffness over polar inertia, D/J, 1/s^2."""
    damping_ratio: NotNegative = 9.0
    """Damping over equatorial inertia, f/A, 1/s."""
    method: Literal["exact", "rk4"] = "exact"
    """How the simulated rotor moves in its steps: by the matrix exponential, or by Runge-Kutta as source 001."""


class FaultConfig(_Model):
    """An instrument of the simulated head that fails."""

    axis: Literal["g1x", "g1y", "g2y", "g2z", "ax", "ay", "az"]
    kind: Literal["stuck", "noise", "jump", "built-in"]
    at_s: NotNegative
    size: Finite = 100.0
    """Of a jump: rad/s or m/s^2. Of noise: times that of the grade (of the DTG grade where there is none)."""


class HeadConfig(_Model):
    """The sensor head: what the simulated one is made of, and what the core takes a real one for."""

    rate_hz: Annotated[float, Field(gt=0, le=10000)] = 1000.0
    layout: Literal["fd", "classic"] = "fd"
    serial: Annotated[int, Field(ge=0, lt=2**32)] = 1
    mounting_deg: Vector = (0.0, 0.0, 0.0)
    """Heading, pitch, roll of the head's axes relative to the body."""
    axes: tuple[AxisName, AxisName, AxisName] | None = None
    """The same where they lie along those of the body: the head's axes that point forward, right and down."""
    mounting: tuple[Vector, Vector, Vector] | None = None
    """The same as a matrix: takes vectors in the head's axes to the body's."""
    lever_arm_m: Vector = (0.0, 0.0, 0.0)
    """Place of the head in the body, forward-right-down of the navigated point."""
    instruments: Literal["ideal", "dtg"] = "ideal"
    """``ideal``: true increments, nothing to compensate; ``dtg``: torquer increments and rotor angles of dynamically tuned gyros,
    pendulum accelerometers with their size effect; the core takes both off."""
    grade: Literal["none", "dtg", "tactical", "mems"] = "none"
    """Errors of ``dtg`` instruments, drawn by the seed; and what the core's tests take for healthy."""
    skew_deg: Finite = 0.0
    """How far each gyro is turned about its spin axis: 0 is the orthogonal layout, 45 the skewed one."""
    rotor: RotorConfig = RotorConfig()
    faults: tuple[FaultConfig, ...] = ()
    errors_seed: Annotated[int, Field(ge=0, lt=2**63)] | None = None
    """Seed of the simulated errors alone, so that runs of one head differ in their noise; left out: that of the scenario."""
    errors_factor: NotNegative = 1.0
    """Simulated turn-on errors, times those of the grade."""
    calibration: Mapping[str, Any] | None = None
    """What is taken off: a file of `hil calibrate` by its name, or the table in it (:mod:`hil.calibration`)."""

    @field_validator("calibration", mode="before")
    @classmethod
    def _read_calibration(cls, value: Any, info: ValidationInfo) -> Any:
        if value is None:
            return None
        from hil.calibration import read, validated

        if isinstance(value, str):
            folder = (info.context or {}).get("folder", Path())
            beside = folder / value
            return read(beside if beside.is_file() else Path(value)).as_table()
        return validated(value, "in the scenario").as_table()

    @field_validator("axes", "mounting")
    @classmethod
    def _turns(cls, value: Any, info: ValidationInfo) -> Any:
        if value is not None:
            try:
                matrix(value) if info.field_name == "axes" else rotation(value)
            except HilError as error:
                raise ValueError(str(error)) from error
        return value

    @model_validator(mode="after")
    def _mounted_once(self) -> Self:
        if any(self.mounting_deg) + (self.axes is not None) + (self.mounting is not None) > 1:
            raise ValueError("mounting_deg, axes and mounting say the same: give one of them")
        return self

    @field_validator("rate_hz")
    @classmethod
    def _whole_microseconds(cls, value: float) -> float:
        if abs(1e6 / value - round(1e6 / value)) > 1e-9:
            raise ValueError("the sample period must be a whole number of microseconds (the head's clock counts them)")
        return value


class Outage(_Model):
    """A time without a measurement."""

    start_s: NotNegative
    end_s: Positive

    @model_validator(mode="after")
    def _forward(self) -> Self:
        if self.end_s <= self.start_s:
            raise ValueError(f"it ends at {self.end_s:g} s, not after its start at {self.start_s:g} s")
        return self


class Jump(_Model):
    """A step of the error, from `at_s` on."""

    at_s: NotNegative
    size: Finite


class VectorJump(_Model):
    """A step of the error of three axes, from `at_s` on."""

    at_s: NotNegative
    size: Vector


class GnssJump(VectorJump):
    """A step of the position, north, east, down, m, and what it grows by: a spoofed receiver."""

    drift_ms: Vector = (0.0, 0.0, 0.0)


class AidConfig(_Model):
    """What all simulated sensors that aid the navigator have."""

    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 5.0
    delay_s: Annotated[float, Field(ge=0, le=10)] = 0.0
    """A measurement arrives so long after it was true."""
    claim: Positive = 1.0
    """Standard deviation that the sensor states, over that of its noise."""
    outages: tuple[Outage, ...] = ()


class GnssConfig(AidConfig):
    """A satellite receiver: position and velocity of its antenna."""

    position_sigma_m: PositiveVector = (1.5, 1.5, 3.0)
    velocity_sigma_ms: PositiveVector = (0.05, 0.05, 0.1)
    bias_sigma_m: NotNegative = 0.0
    """A first-order Gauss-Markov error of each axis of the position, which the stated deviation leaves out."""
    bias_time_s: Positive = 300.0
    lever_arm_m: Vector = (0.0, 0.0, 0.0)
    """Place of the antenna in the body, forward-right-down of the navigated point."""
    jumps: tuple[GnssJump, ...] = ()


class BaroConfig(AidConfig):
    """A barometer: height, with an offset that drifts."""

    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 10.0
    sigma_m: Positive = 0.3
    offset_m: Finite = 0.0
    bias_sigma_m: NotNegative = 2.0
    bias_time_s: Positive = 600.0
    jumps: tuple[Jump, ...] = ()


class MagnetometerConfig(AidConfig):
    """A magnetometer along the body axes."""

    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 25.0
    sigma_ut: Positive = 0.3
    hard_iron_ut: Vector = (0.0, 0.0, 0.0)
    jumps: tuple[VectorJump, ...] = ()


class HeadingConfig(AidConfig):
    """Two antennas: true heading."""

    sigma_deg: Positive = 0.2
    offset_deg: Finite = 0.0
    jumps: tuple[Jump, ...] = ()


class AidingConfig(_Model):
    """What the simulated world sends besides the head, on the same bus."""

    gnss: tuple[GnssConfig, ...] = ()
    baro: tuple[BaroConfig, ...] = ()
    magnetometer: tuple[MagnetometerConfig, ...] = ()
    heading: tuple[HeadingConfig, ...] = ()
    field: Literal["dipole", "wmm"] = "dipole"
    """The Earth's magnetic field: a centred dipole, or the World Magnetic Model."""
    year: Annotated[float, Field(ge=2025, le=2030)] = 2026.0
    """Of the World Magnetic Model."""


class ReceiverConfig(_Model):
    """A real receiver of satellite navigation at a port of its own."""

    port: str
    protocol: Literal["auto", "ubx", "nmea"] = "auto"
    lever_arm_m: Vector = (0.0, 0.0, 0.0)
    """Place of the antenna in the body, forward-right-down of the navigated point."""
    delay_s: Annotated[float, Field(ge=0, le=1)] = 0.0
    """How old the fastest fix is when it arrives."""
    range_error_m: Positive = 4.0
    """NMEA without GST: the position errs by this times the dilution of precision, one sigma."""
    speed_error_ms: Positive = 0.3
    """NMEA: one sigma of the velocity."""
    heading_error_deg: Positive = 1.0
    """NMEA: one sigma of a heading."""
    heading_offset_deg: Finite = 0.0
    """Heading of the line between two antennas less that of the body."""

    @field_validator("port")
    @classmethod
    def _serial(cls, value: str) -> str:
        if not value.startswith("serial:"):
            raise ValueError("a receiver is at a serial port: serial:/dev/ttyACM0:115200")
        return value


class StartConfig(_Model):
    """A known start; what is left out comes from the alignment or from the motion's truth."""

    latitude_deg: Annotated[float, Field(ge=-90, le=90)] | None = None
    longitude_deg: Annotated[float, Field(ge=-180, le=180)] | None = None
    height_m: Finite | None = None
    heading_deg: Finite | None = None
    heading_sigma_deg: Positive = 0.2
    """How sure the heading is at the start, at best: of a given one, or of an alignment that supposes more."""


class WithheldConfig(Outage):
    """Aiding that the navigator is not given, from the start of the samples on: to see what it does without."""

    kind: Literal["gnss", "baro", "magnetic", "heading", "attitude", "body_velocity"]


class FilterConfig(_Model):
    """What the error-state filter believes, where ``aided``."""

    grade: Literal["dtg", "tactical", "mems"] | None = None
    """Of the inertial sensors; left out: that of the head, and dtg for one without a grade."""
    gyro_deg_sqrt_h: Positive | None = None
    """Angle random walk; left out: that of the grade. More for a vehicle that shakes: what lies above the sample rate folds."""
    accelerometer_ms_sqrt_h: Positive | None = None
    """Velocity random walk; left out: that of the grade."""
    magnetic: Literal["field", "heading"] = "field"
    """What is taken of a magnetometer: all of the flux, or where its level part points, whatever its scale."""
    declination_deg: Finite | None = None
    """East of true north; left out: that of ``aiding.field`` where the run starts."""
    barometer_m_sqrt_s: NotNegative = 0.15
    """Random walk of the pressure height against that of GNSS: the weather, and the slow errors of the fixes."""
    withheld: tuple[WithheldConfig, ...] = ()


class BoundsConfig(_Model):
    """What the vehicle does on the long run, one sigma of each axis."""

    acceleration_ms2: Positive
    """The specific force is the vertical but for this, and for more where it manoeuvres."""
    speed_ms: Positive
    place_m: Positive
    """Distance from the start."""


class AssumeConfig(_Model):
    """What the filter may know of the vehicle without another sensor (:mod:`nav.filter.assumptions`)."""

    rest: Literal["never", "detected"] = "never"
    """``detected``: a vehicle whose inertial samples are still, and that is not known to move, is at rest."""
    smooth_ms: Positive = 5.0
    """From this speed on the vehicle may move as smoothly as it stands: no rest is assumed unless it is known to be slower."""
    bounds: BoundsConfig | None = None
    """Attitude and heading without a receiver: gravity is the vertical, velocity and place are bounded."""
    wheels_ms: Positive | None = None
    """A vehicle on wheels: it moves sideways and upwards by no more than this, one sigma, where the navigated point is."""


class NavigationConfig(_Model):
    """The navigation core."""

    alignment: Literal["gyrocompass", "level", "swaying", "moving", "transfer", "truth"] = "gyrocompass"
    """``gyrocompass``: vertical and north from rest; ``level``: vertical from rest, heading given, gyro bias captured;
    ``swaying``: both from a base that sways in its place; ``moving``: both in motion, with GNSS; ``transfer``: from another
    navigator's attitude and fix; ``truth``: the simulated start, no alignment."""
    align_s: Annotated[float, Field(ge=0.5, le=3600)] = 30.0
    sway_m: Positive = 0.3
    """How far a swaying base moves about its mean place, one sigma an axis."""
    start: StartConfig = StartConfig()
    attitude: str = "two-sample"
    mechanization: str = "geographic"
    gravity: Literal["normal", "j2"] = "normal"
    gap_interpolate_s: NotNegative = 0.1
    """Gaps up to this length are filled by interpolation; longer ones are bridged and the mode is degraded."""
    gap_realign_s: Positive = 10.0
    """After a gap longer than this nothing is bridged: the navigator aligns again."""
    silence_s: Annotated[float, Field(gt=0, le=10)] = 0.08
    """Without a sample for this long the mode is degraded."""
    aided: bool = False
    """Use what comes besides the inertial samples: the error-state filter corrects the navigator."""
    filter: FilterConfig = FilterConfig()
    assume: AssumeConfig = AssumeConfig()
    track_bias_at_rest: bool = False
    """Keep averaging the gyro bias while the vehicle stands (boards that cannot gyrocompass)."""

    @property
    def aligned_by_aiding(self) -> bool:
        """The alignment uses measurements besides the inertial ones."""
        no_heading = self.alignment == "level" and self.start.heading_deg is None
        return no_heading or self.alignment in ("moving", "transfer")

    @model_validator(mode="after")
    def _consistent(self) -> "NavigationConfig":
        if self.assume != AssumeConfig(smooth_ms=self.assume.smooth_ms) and not self.aided:
            raise ValueError("assume needs the filter: aided = true")
        return self


class LinkConfig(_Model):
    """A MAVLink link with options of its own."""

    url: str
    rates_hz: Mapping[str, NotNegative] = Field(default_factory=dict)
    """Message name to rate, over those of all links."""
    only: tuple[str, ...] = ()
    """Messages that may go out here; none named: all."""
    hear: bool = True
    """False: what comes in is neither answered nor obeyed."""
    sign: bool = True
    """False: without signatures where there is a key."""
    tlog: str = ""
    """File for what is sent and received."""


class MavlinkConfig(_Model):
    """Where and how often the solution goes out as MAVLink."""

    links: tuple[str | LinkConfig, ...] = ("udpout:127.0.0.1:14550",)
    system_id: Annotated[int, Field(ge=1, le=255)] = 1
    component_id: Annotated[int, Field(ge=1, le=255)] = 1
    vehicle: Literal["fixed-wing", "quadrotor", "helicopter", "ground-rover", "surface-boat", "generic"] = "fixed-wing"
    rates_hz: Mapping[str, NotNegative] = Field(default_factory=dict)
    """Message name to rate, over the built-in rates; 0 switches a message off."""
    aiding: bool = False
    """Take measurements from the network."""
    operator: bool = False
    """Take position and heading from a person at a ground station."""
    aiding_from: tuple[Annotated[int, Field(ge=1, le=255)], ...] = (255,)
    """Systems that may send measurements, position, heading and home."""
    aiding_delay_s: Annotated[float, Field(ge=0, le=1)] = 0.0
    """How old they are when they come."""
    master: tuple[Annotated[int, Field(ge=1, le=255)], Annotated[int, Field(ge=1, le=255)]] | None = None
    """System and component of another inertial system, whose position, velocity and attitude are taken."""
    signing_key: str = ""
    """File of the key; empty: nothing is signed."""
    accept_unsigned: tuple[str, ...] = ()
    """Messages that are taken without a signature."""
    keep_parameters: bool = True
    """What a ground station sets holds in later runs."""


class Scenario(_Model):
    """One run."""

    name: str = "unnamed"
    description: str = ""
    duration_s: Positive | None = None
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    bus: str = ""
    """Where the sensor is; empty: `hil run` brings its own simulated head on a private ``unix:`` bus."""
    driver: str = "dtg-head"
    motion: MotionConfig = MotionConfig()
    head: HeadConfig = HeadConfig()
    aiding: AidingConfig = AidingConfig()
    wire: tuple[WireFault, ...] = ()
    """What becomes of the simulated head's frames on their way."""
    receiver: Annotated[tuple[ReceiverConfig, ...], Field(max_length=16)] = ()
    navigation: NavigationConfig = NavigationConfig()
    mavlink: MavlinkConfig = MavlinkConfig()
    feed: Annotated[tuple[FeedConfig, ...], Field(max_length=16)] = ()
    """Autopilots that are given the solution (:mod:`hil.feed`)."""

    @model_validator(mode="after")
    def _carried(self) -> "Scenario":
        aiding = self.aiding
        if self.head.layout == "classic" and (aiding.gnss or aiding.baro or aiding.magnetometer or aiding.heading):
            raise ValueError('simulated aiding needs CAN FD: head.layout = "fd"')
        if self.mavlink.aiding and not self.navigation.aided:
            raise ValueError("mavlink.aiding needs a navigator that takes measurements: navigation.aided = true")
        if self.mavlink.master is not None and not self.mavlink.aiding:
            raise ValueError("mavlink.master is followed with mavlink.aiding = true only")
        return self

    def with_changes(self, **changes: Any) -> "Scenario":
        """A copy with `changes` laid over it (nested dictionaries reach nested keys), validated anew."""
        return validated(_merged(self.model_dump(mode="json"), changes), "command line")

    def with_receivers(self, ports: Sequence[str]) -> "Scenario":
        """A copy with receivers at `ports`, which aid the navigator; the first ones are those of the scenario, at other ports."""
        known = [one.model_dump(mode="json") for one in self.receiver]
        receivers = [{**dict(enumerate(known)).get(k, {}), "port": port} for k, port in enumerate(ports)]
        return self.with_changes(receiver=receivers, navigation={"aided": True})

    def world_id(self) -> int:
        """A 32-bit fingerprint of what the simulated head does: motion, head and seed; never 0.

        The simulated head announces it, so that a bridge elsewhere knows whether its own truth applies. Keys at their default
        do not count, so that a new key changes no fingerprint of a recording.
        """
        kept = {"motion", "head", "seed"}
        world = self.model_dump(mode="json", include=kept, exclude={"head": {"calibration"}}, exclude_defaults=True)
        world = {key: value for key, value in world.items() if value}
        return zlib.crc32(json.dumps(world, sort_keys=True).encode()) or 1


def load(path_or_name: str | Path | None) -> Scenario:
    """The scenario in a TOML file, or a built-in one by name; None is the embedded default.

    Raises
    ------
    HilError
        The file is missing or cannot be read, is not TOML, or a key is unknown or has a wrong value.
    """
    source = "default" if path_or_name is None else str(path_or_name)
    built_in = files("fixtures") / "scenarios" / f"{source}.toml"
    path = Path(source)
    folder = path.parent
    if path.suffix != ".toml" and built_in.is_file():
        text, source = built_in.read_text(), f"built-in scenario {source}"
    else:
        try:
            text = path.read_text()
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "not a text file"
            raise HilError(
                f"scenario {source}: {reason}; give a TOML file or one of: {', '.join(built_in_names())}"
            ) from error
    return parse(text, source, folder)


def parse(text: str, source: str, folder: Path = Path()) -> Scenario:
    """The scenario in a TOML text; `source` names it in errors, files that it names are looked for in `folder` first.

    Raises
    ------
    HilError
        As for `load`.
    """
    return validated(parse_toml(text, f"scenario {source}"), source, folder)


def built_in_names() -> list[str]:
    """Names of the built-in scenarios."""
    folder = files("fixtures") / "scenarios"
    return sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml"))


def validated(table: Mapping[str, Any], source: str, folder: Path = Path()) -> Scenario:
    """The scenario in a table of plain values; `source` names it in errors.

    Raises
    ------
    HilError
        A key is unknown or has a wrong value.
    """
    try:
        return Scenario.model_validate(table, context={"folder": folder})
    except ValidationError as error:
        raise HilError(explained(error, f"scenario {source}")) from error


def explained(error: ValidationError, source: str) -> str:
    """A line for each key that is wrong: source, key, value, and what was expected."""
    lines = []
    for problem in error.errors():
        key = ".".join(str(part) for part in problem["loc"]) or source.split(maxsplit=1)[0]
        what = "unknown key" if problem["type"] == "extra_forbidden" else problem["msg"]
        value = "" if isinstance(problem["input"], Mapping) else f" = {problem['input']!r}"
        lines.append(f"{source}: {key}{value}: {what}")
    return "\n".join(lines)


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in changes.items():
        inner = merged.get(key)
        merged[key] = _merged(inner, value) if isinstance(value, Mapping) and isinstance(inner, Mapping) else value
    return merged
