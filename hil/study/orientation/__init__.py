"""Attitude methods on motions in closed form: the figures of Fomichev 2011, coning, and the order of every method.

An error is the rotation from the true attitude to the computed one, the largest at block ends.
"""

from hil.study.orientation.coning import cones
from hil.study.orientation.fomichev import published_figures
from hil.study.orientation.orders import all_orders
from hil.study.report import Plot, Row, Study


def run() -> Study:
    """All of it."""
    rows: list[Row] = []
    plots: list[Plot] = []
    for part in (published_figures, cones, all_orders):
        more_rows, more_plots = part()
        rows += more_rows
        plots += more_plots
    about = (
        "Attitude from exact increments of motions known in closed form. Error: the largest rotation between computed and "
        "true attitude at block ends. Precession: 40 attitudes a second, four samples each, as in the source. Orders: slopes "
        "over three halvings of the step."
    )
    return Study("orientation", "Attitude methods", about, rows, plots)
