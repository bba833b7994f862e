"""Alignment grade by grade, beside its theory: at rest, swaying, in flight, made fine by the filter; tracking correction."""

from hil.study.alignment.fine import fine
from hil.study.alignment.flying import flying
from hil.study.alignment.standing import standing
from hil.study.report import Study

SEEDS, DURATION_S = 50, 600.0
"""Runs at rest and swaying, and their length, s."""
FLIGHTS, FLIGHT_ALIGNMENT_S = 20, 120.0
"""Alignments in flight."""
TRACKED, TRACKED_S = 4, 300.0
"""Flights with the tracking correction."""
REFINED_S = 300.0
"""Flights that the filter makes fine."""


def run(
    seeds: int = SEEDS,
    duration: float = DURATION_S,
    flights: int = FLIGHTS,
    flight_s: float = FLIGHT_ALIGNMENT_S,
    tracked: int = TRACKED,
    tracked_s: float = TRACKED_S,
    refined_s: float = REFINED_S,
) -> Study:
    """All of it; some minutes."""
    rows, plots = standing(seeds, duration)
    more_rows, more_plots = flying(flights, flight_s, tracked_s, tracked)
    fine_rows, fine_plots = fine(flights, duration, refined_s)
    about = (
        "Instruments drawn from the table of grades, gyro bias removed at rest as far as the grade says, each run at a heading "
        "of its own. Swaying: a ship at its mooring, roll 5, pitch 2, yaw 1.5 deg, heave and sway of 0.2 to 0.3 m, periods of 5 "
        "to 10 s; the alignment is told the latitude and 0.3 m. In flight: the built-in flight with turns, GNSS 5 Hz, 1.5 m and "
        "0.1 m/s an axis, four antennas with 5 mm of phase noise. "
        "The y axes of the DTG head are weighted by what gravity does to each in a level vehicle, as in the product."
    )
    return Study(
        "alignment",
        "Alignment and tracking, grade by grade",
        about,
        rows + more_rows + fine_rows,
        plots + more_plots + fine_plots,
    )
