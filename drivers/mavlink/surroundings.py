"""What barometer and magnetometer of an autopilot would show where a solution is: made of the solution, not measured."""

from dataclasses import dataclass

from drivers.mavlink.solution import Solution, Vector
from nav.atmosphere import standard_atmosphere


@dataclass(frozen=True, slots=True)
class Surroundings:
    """Air and field around the vehicle.

    Attributes
    ----------
    pressure, temperature : float
        Pa, K.
    flux_b : (3,) float
        Magnetic flux density along the body axes, T.
    """

    pressure: float
    temperature: float
    flux_b: Vector

    @classmethod
    def of(cls, solution: Solution, flux_n: Vector) -> "Surroundings":
        """The standard atmosphere at its altitude, and a field given north, east, down, T."""
        return cls(*standard_atmosphere(solution.altitude), solution.in_body(flux_n))
