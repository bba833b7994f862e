"""What a scenario says of an autopilot feed."""

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from nav.errors import HilError

DEFAULTS = {"ardupilot-json": "127.0.0.1:9002", "px4": "127.0.0.1:4560", "vectornav": "pty"}
"""Address of each kind."""
FORMS = {
    "ardupilot-json": "HOST:PORT",
    "px4": "HOST:PORT",
    "vectornav": "pty, pty:PATH, tcp:HOST:PORT or serial:/dev/NAME:BAUD",
}


class FeedConfig(BaseModel):
    """One feed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["ardupilot-json", "px4", "vectornav"]
    address: str = ""
    """Where the autopilot finds us; empty: that of `DEFAULTS`."""
    rates: Literal["navigated", "compensated"] = "navigated"
    """Angular rates without the gyro bias that the navigator knows, or as they come from the compensation."""
    rate_hz: Annotated[float, Field(ge=50, le=2000)] = 250.0
    """HIL_SENSOR."""
    gps_hz: Annotated[float, Field(ge=1, le=20)] = 10.0
    """HIL_GPS."""
    derived: bool = True
    """Magnetometer, barometer and receiver, which are made of the solution, go to PX4 too."""
    claim_m: Annotated[float, Field(gt=0, le=600)] = 1.0
    """One sigma of the position that is stated where the navigator does not know it."""
    claim_ms: Annotated[float, Field(gt=0, le=600)] = 0.1
    """And of the velocity."""
    patience_s: Annotated[float, Field(gt=0, le=86400)] = 60.0
    """In simulated time, which waits for the autopilot: longest silence of it."""

    @model_validator(mode="after")
    def _addressed(self) -> Self:
        kind, _, rest = self.place.partition(":")
        if self.kind == "vectornav":
            good = kind == "pty" or (kind in ("tcp", "serial") and ":" in rest)
        else:
            good = bool(kind) and _is_port(self.place.rpartition(":")[2])
        if not good:
            raise ValueError(f"address {self.address!r}: expected {FORMS[self.kind]}")
        return self

    @property
    def place(self) -> str:
        """The address."""
        return self.address or DEFAULTS[self.kind]

    @property
    def listens(self) -> str:
        """Where the network may come in, as the URL of a link; empty: nowhere."""
        kind, _, rest = self.place.partition(":")
        if self.kind == "vectornav":
            return f"tcpin:{rest}" if kind == "tcp" else ""
        return f"{'tcpin' if self.kind == 'px4' else 'udpin'}:{self.place}"

    @property
    def name(self) -> str:
        """Kind and address, as ``--feed`` takes them."""
        return f"{self.kind}:{self.place}"


def parse_feed(text: str) -> dict[str, str]:
    """``KIND`` or ``KIND:ADDRESS`` of the command line as a table of a scenario.

    Raises
    ------
    HilError
        Another kind.
    """
    kind, _, address = text.partition(":")
    if kind not in DEFAULTS:
        forms = ", ".join(f"{one}:{form}" for one, form in FORMS.items())
        raise HilError(f"--feed {text}: unknown kind {kind!r}; expected {forms}")
    return {"kind": kind, "address": address}


def _is_port(text: str) -> bool:
    return text.isascii() and text.isdigit() and int(text) < 65536
