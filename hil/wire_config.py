"""Faults of the wire between the simulated head and the bridge, as a scenario says them: a ``[[wire]]`` table each."""

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from nav.errors import HilError

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
SERIAL = ("microstrain-mip", "vectornav", "xsens-xbus")
"""Emulated boards on a serial port."""
COUNTING = ("xsens-xbus",)
"""Those of them that count their samples."""


class WireFault(BaseModel):
    """One fault, by the time of the samples (:mod:`hil.world.faults` says what each kind does)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal[
        "drop",
        "duplicate",
        "reorder",
        "delay",
        "jitter",
        "bit-flip",
        "counter-freeze",
        "crc-off",
        "silence",
        "unplugged",
        "babble",
        "clock-step",
        "clock-drift",
    ]
    at_s: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    for_s: Positive | None = None
    """Left out: to the end."""
    share: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Of the frames that are dropped, sent twice or damaged, or of the samples that change places."""
    delay_s: Annotated[float, Field(gt=0, le=10)] = 0.02
    """Of ``delay``, and the longest of ``jitter``."""
    step_s: Annotated[float, Field(allow_inf_nan=False)] = 0.5
    """Of the device's clock."""
    drift_ppm: Annotated[float, Field(gt=-100_000, lt=100_000)] = 200.0
    """Of the device's clock: positive runs fast."""
    rate_hz: Annotated[float, Field(gt=0, le=100_000)] = 5000.0
    """Frames of the babbling node a second; on a serial line 8 bytes each."""

    @model_validator(mode="after")
    def _steps(self) -> Self:
        if self.kind == "clock-step" and self.step_s == 0.0:
            raise ValueError("a clock step needs a step_s that is not 0")
        return self

    def holds(self, time_s: float) -> bool:
        """Whether it is there at `time_s`."""
        return self.at_s <= time_s < self.end_s

    @property
    def end_s(self) -> float:
        """When it is over."""
        return float("inf") if self.for_s is None else self.at_s + self.for_s


def check_board(driver: str, bus: str, faults: tuple[WireFault, ...]) -> None:
    """Refuse (`HilError`) what the board of `driver` on `bus` cannot have."""
    for fault in faults:
        if fault.kind == "crc-off" and driver != "dtg-head":
            raise HilError(f"wire.kind = 'crc-off': the frames of {driver} carry no check that can be left out")
        if fault.kind == "counter-freeze" and driver in SERIAL and driver not in COUNTING:
            raise HilError(f"wire.kind = 'counter-freeze': a {driver} counts no samples")
        if fault.kind == "unplugged" and not bus.startswith("pty:"):
            raise HilError("wire.kind = 'unplugged': only a port can be pulled out: hil imu SCENARIO --bus pty:PATH")
