"""Navigation on error-free increments of flights in closed form: how exact each method is, and the figures of the sources.

An error is the largest distance, in three dimensions, between the computed and the true place, twice a second.
"""

from hil.study.navigation.azimuth import wander_azimuth
from hil.study.navigation.exactness import exact_flights, frames, orders
from hil.study.navigation.pole import over_the_pole
from hil.study.navigation.source import source_method
from hil.study.report import Plot, Row, Study


def run() -> Study:
    """All of it."""
    rows: list[Row] = []
    plots: list[Plot] = []
    for part in (exact_flights, orders, frames, over_the_pole, source_method, wander_azimuth):
        more_rows, more_plots = part()
        rows += more_rows
        plots += more_plots
    about = (
        "Error-free increments of flights known in closed form, 2050 s each. Agile: 230 m/s, bank of 30 degrees to both sides "
        "every 35 s, attitude shaken by 1 to 2 degrees at 0.5 to 1 Hz. Smooth: the built-in flight without its rest. Error: "
        "the largest distance from the true place. High order works in blocks of the record, to both sides."
    )
    return Study("navigation", "Navigation on error-free increments", about, rows, plots)
