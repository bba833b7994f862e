"""What the table ``[filter]`` of INIT.toml says: how an offline flight is aided."""

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from hil.magnetic import magnetic_field
from hil.scenario import NotNegative, Vector, explained
from nav.errors import HilError
from nav.filter.aided import Settings
from nav.filter.states import SENSOR_BLOCKS, Block, Tuning, tuning
from nav.increments import FloatArray
from nav.instruments.grades import GRADES

NotNegatives = tuple[NotNegative, NotNegative, NotNegative]


class FilterConfig(BaseModel):
    """How the filter is set; sigmas are those of the start."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    grade: Literal["dtg", "tactical", "mems"]
    """What the sensors are worth."""
    attitude_sigma_deg: NotNegatives
    """About north, east and down: tilt, tilt, heading."""
    position_sigma_m: NotNegatives = (5.0, 5.0, 5.0)
    velocity_sigma_ms: NotNegatives = (0.1, 0.1, 0.1)
    bias_removed: bool = False
    """The gyros' turn-on bias has been removed at rest."""
    estimate: tuple[str, ...] = tuple(block.name.lower() for block in (*SENSOR_BLOCKS, Block.BAROMETER_BIAS))
    """Parameters with states of their own, of `nav.filter.states.Block`."""
    lever_arm_m: Vector = (0.0, 0.0, 0.0)
    """From the IMU to the GNSS antenna: forward, right, down."""
    lever_arm_sigma_m: NotNegative = 0.1
    gnss_delay_s: NotNegative = 0.0
    """GNSS is so much older than its times say."""
    gnss_delay_sigma_s: NotNegative = 0.02
    barometer_sigma_m: NotNegative = 10.0
    """Of the barometer's offset."""
    field: Literal["dipole", "wmm"] | None = None
    """The Earth's magnetic field; without it no magnetic row is taken."""
    year: Annotated[float, Field(ge=2025, le=2030)] = 2026.0

    def tuning(self) -> Tuning:
        """What the filter believes."""
        return tuning(
            GRADES[self.grade],
            [Block[name.upper()] for name in self.estimate],
            bias_removed=self.bias_removed,
            lever_arm=self.lever_arm_sigma_m,
            delay=self.gnss_delay_sigma_s,
            barometer=self.barometer_sigma_m,
        )

    def settings(self, lat: float, lon: float, height: float) -> Settings:
        """How it is run, from a place in rad and m."""
        field = None if self.field is None else magnetic_field(self.field, lat, lon, height, self.year)
        return Settings(
            lever_arm=self.lever_arm_m,
            delay=self.gnss_delay_s,
            field_n=None if field is None else (float(field[0]), float(field[1]), float(field[2])),
        )

    @property
    def sigma(self) -> FloatArray:
        """(9,): of the start, m, m/s, rad."""
        return np.array([*self.position_sigma_m, *self.velocity_sigma_ms, *np.radians(self.attitude_sigma_deg)])


def read_filter(table: Any, source: str) -> FilterConfig:
    """The table, validated; `source` names it in errors.

    Raises
    ------
    HilError
        A key is missing, unknown or has a wrong value.
    """
    try:
        config = FilterConfig.model_validate(table)
    except ValidationError as error:
        raise HilError(explained(error, source)) from error
    known = [block.name.lower() for block in Block]
    for name in config.estimate:
        if name not in known:
            raise HilError(f"{source}: estimate = {name!r}: expected some of {', '.join(known)}")
    return config
