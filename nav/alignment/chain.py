"""The alignment chain: which ways there are, and which of them a grade of sensors can go.

    at rest      gyrocompass   vertical and north by force and rate          sensors that feel the Earth's rate
                 level         vertical; heading given or from a source      any
    in motion    swaying       by optimisation at a mooring                  sensors that feel the Earth's rate
                 moving        by optimisation with GNSS; turns show more    any that hold the attitude meanwhile
                 transfer      from another navigator's attitude and fix     any

What is coarse is made fine by the filter (:mod:`nav.filter.aided`), which begins with the sigmas that the alignment states.
"""

import math

from nav.alignment.analytic import AlignmentRefused
from nav.alignment.moving import InMotion, Transfer
from nav.alignment.plan import Aligner, Plan
from nav.alignment.rest import Sensors
from nav.alignment.standing import GYROCOMPASS_LIMIT, AtRest
from nav.earth import RATE
from nav.increments import FloatArray


def aligner(plan: Plan, place: FloatArray) -> Aligner:
    """The way of the plan, at its beginning.

    Parameters
    ----------
    plan : Plan
        How.
    place : (3,) float
        Of the navigated point, where the way needs one: lat, lon (rad), height (m).
    """
    if plan.way == "transfer":
        return Transfer(plan)
    return InMotion(plan, place) if plan.way in ("swaying", "moving") else AtRest(plan, place)


def heading_limit(sensors: Sensors, lat: float) -> float:
    """What the gyro bias alone leaves of a heading that is found by the Earth's rate: bias / (U cos B), one sigma, rad."""
    return sensors.gyro_bias / (RATE * max(math.cos(lat), 1e-9))


def check_grade(plan: Plan) -> None:
    """Refuse sensors that cannot find north by themselves, where the plan leaves it to them.

    Raises
    ------
    AlignmentRefused
        Says what the heading would be worth, and what gives one instead.
    """
    limit = heading_limit(plan.sensors, plan.lat)
    if plan.way not in ("gyrocompass", "swaying") or limit <= GYROCOMPASS_LIMIT:
        return
    bias = math.degrees(plan.sensors.gyro_bias) * 3600.0
    found = f"to {math.degrees(limit):.2g} deg only" if limit < 1.0 else "not at all"
    raise AlignmentRefused(
        f'navigation.alignment = "{plan.way}": a gyro bias of {bias:.3g} deg/h finds north '
        f"{found} at latitude {math.degrees(plan.lat):.1f} deg (bias / (U cos B); {math.degrees(GYROCOMPASS_LIMIT):g} deg are "
        'asked). Give a heading source: navigation.alignment = "level" with navigation.start.heading_deg or a heading sensor, '
        '"moving" with GNSS, or "transfer" from another navigator'
    )
