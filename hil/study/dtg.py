"""The dynamically tuned gyro: the tables of source 001, where rotor and integrator are stable, the lag and its compensation."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hil.study.dtg_vibration import WORDS, roll_rows, vibration
from hil.study.dtg_world import FORMS, STEP_S, Rocking, body, outputs, response, simulated_responses
from hil.study.report import Line, Plot, Row, Study, at_most, near, shown
from nav.attitude import method
from nav.increments import FloatArray
from nav.instruments.dtg import HEAD, SOURCE, Rotor, respond
from nav.instruments.dtg_response import Response, compensated_response, noise_gain, noise_spectrum, raw_response
from nav.instruments.dtg_stability import Kind, growth, stability
from nav.rotation import euler_from_quaternion

TURN = 2.0 * math.pi
ROLL_DEG = 10.0
TABLE_1 = {0.5: 10.0, 1.0: 9.95, 2.0: 9.65, 4.0: 8.83, 8.0: 6.80}
"""Amplitude, deg, by pulsation of the roll, rad/s."""
TABLE_2 = {130: 9.98, 143: 9.97, 170: 9.95, 200: 9.93, 250: 9.89, 270: 9.88, 320: 9.83, 337: 9.81}
"""Amplitude, deg, by rotor speed, Hz; roll at 1 rad/s."""
STABLE_HZ = (130.0, 337.0)
"""As published, without a word that this is the integrator."""
SETTLED_S, RECORD_S = 5.0, 30.0
PULSATIONS = (0.1, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 50.0)
LIMITS = {"amplitude": ("%", 0.01), "phase": ("deg", 0.02), "leak to the other axis": ("%", 0.001)}
COMPENSATED = FORMS[1:]
METHODS = ("poisson-rk4", "euler-vector-rk4")
LAG_ERROR = 1.02
WRONG = {
    "lag": ("lag taken 2 % too long", replace(HEAD, cross_stiffness=HEAD.cross_stiffness / LAG_ERROR)),
    "damping": ("damping taken 20 % too large", replace(HEAD, damping=1.2 * HEAD.damping)),
}
"""What the head rotor may be taken for."""


def source_roll(pulsation: float, rotor: Rotor = SOURCE) -> tuple[FloatArray, FloatArray]:
    """Roll by the source's integration of the gyro: RK4 at 1 ms, from rest.

    Returns
    -------
    rate : (n + 1, 3) float
        Measured body rates at the start and after each step, rad/s.
    dtheta : (n, 3) float
        Their integrals over the steps, rad.
    """
    time = np.arange(round(RECORD_S / STEP_S) + 1) * STEP_S
    w = np.zeros((len(time), 2))
    w[:, 0] = math.radians(ROLL_DEG) * pulsation * np.cos(pulsation * time)
    angle, swept = respond(rotor, w, STEP_S, "rk4")
    rate, dtheta = np.zeros((len(time), 3)), np.zeros((len(time) - 1, 3))
    rate[1:, :2], dtheta[:, :2] = -angle / rotor.lag, -swept / rotor.lag
    return rate, dtheta


def amplitude_deg(angle: FloatArray) -> float:
    """Half the swing of an angle (n,) rad after the first seconds, deg."""
    return math.degrees(0.5 * float(np.ptp(angle[round(SETTLED_S / STEP_S) :])))


def _tables() -> tuple[list[Row], list[Plot]]:
    rows = []
    for pulsation, published in TABLE_1.items():
        ours = amplitude_deg(np.cumsum(source_roll(pulsation)[1][:, 0]))
        reference = ROLL_DEG * abs(raw_response(SOURCE, pulsation).same)
        what = f"table 1: amplitude of a roll of 10 deg at {pulsation:g} rad/s (reference: steady state)"
        key = f"table-1-{pulsation:g}"
        rows.append(near(key, what, ours, "deg", 0.05, published=published, reference=float(reference)))
    for spin_hz, published in TABLE_2.items():
        rotor = replace(SOURCE, spin=TURN * spin_hz)
        ours = amplitude_deg(np.cumsum(source_roll(1.0, rotor)[1][:, 0]))
        reference = ROLL_DEG * abs(raw_response(rotor, 1.0).same)
        what = f"table 2: amplitude of a roll of 10 deg at 1 rad/s, rotor at {spin_hz} Hz (reference: steady state)"
        key = f"table-2-{spin_hz}"
        rows.append(near(key, what, ours, "deg", 0.02, published=published, reference=float(reference)))
    w, hz = np.linspace(0.1, 8.0, 80), np.linspace(130.0, 337.0, 80)
    by_speed = np.array([10.0 * abs(raw_response(replace(SOURCE, spin=TURN * f), 1.0).same) for f in hz])
    return rows, [
        Plot(
            "table-1",
            "Error of a roll of 10 deg (source: fig. 7)",
            "rad/s",
            "deg",
            [
                Line("steady state", w, -10.0 * raw_response(SOURCE, w).amplitude_error),
                Line("published", np.array([*TABLE_1]), 10.0 - np.array([*TABLE_1.values()]), "o"),
            ],
        ),
        Plot(
            "table-2",
            "Error of a roll of 10 deg at 1 rad/s (source: fig. 8)",
            "rotor speed, Hz",
            "deg",
            [
                Line("steady state", hz, 10.0 - by_speed),
                Line("published", np.array([*TABLE_2], np.float64), 10.0 - np.array([*TABLE_2.values()]), "o"),
            ],
        ),
    ]


def _chart() -> tuple[list[Row], list[Plot]]:
    """Stability over the rotor speed, D held constant."""
    ((low, high),) = stability(SOURCE, "rk4", STEP_S).intervals
    edge = 2.0 * math.sqrt(2.0) * SOURCE.equatorial_inertia / (SOURCE.polar_inertia * STEP_S) / TURN
    rows = [
        near("stable-rk4-from", "RK4 at 1 ms is stable from", low / TURN, "Hz", 1.0, published=STABLE_HZ[0]),
        near(
            "stable-rk4-to",
            "RK4 at 1 ms is stable to (reference: H dt / A = 2 sqrt 2)",
            high / TURN,
            "Hz",
            1.0,
            published=STABLE_HZ[1],
            reference=edge,
        ),
    ]
    kinds: tuple[Kind, ...] = ("continuous", "exact")
    for name, rotor in (("source", SOURCE), ("head", HEAD)):
        relative = rotor.damping / rotor.equatorial_inertia
        limit = rotor.cross_stiffness / rotor.polar_inertia / relative / TURN
        for kind in kinds:
            ours = stability(rotor, kind, STEP_S).intervals[0][0] / TURN
            what = f"{name} rotor, {kind}: stable from, and no upper limit (reference: f/A = D/H)"
            rows.append(near(f"stable-{name}-{kind}", what, ours, "Hz", 0.1, reference=limit))
        what = f"{name} rotor at 228 Hz: growth of the nutation (reference: D/H - f/A)"
        rows.append(
            near(f"growth-{name}", what, rotor.modes()[0].real, "1/s", 0.01, reference=1.0 / rotor.lag - relative)
        )
    hz = np.linspace(100.0, 700.0, 601)
    lines = []
    for label, rotor, kind, style in (
        ("source: continuous", SOURCE, "continuous", "-"),
        ("source: exact, 1 ms", SOURCE, "exact", ":"),
        ("source: rk4, 1 ms", SOURCE, "rk4", "-"),
        ("head: continuous", HEAD, "continuous", "-"),
    ):
        grows = np.array([growth(replace(rotor, spin=TURN * f), kind, STEP_S) for f in hz])
        shown_part = grows < 20.0
        lines.append(Line(label, hz[shown_part], grows[shown_part], style))
    lines.append(Line("published interval", np.array(STABLE_HZ), np.zeros(2), "o-"))
    title = "Growth of the fastest mode, D held constant: stable below 0"
    return rows, [Plot("stability", title, "rotor speed, Hz", "1/s", lines)]


def _lag() -> tuple[list[Row], list[Plot]]:
    """Raw and compensated output over frequency, simulated beside the closed forms."""
    w, dense = np.array(PULSATIONS), np.geomspace(0.1, 50.0, 400)
    simulated = simulated_responses(HEAD, PULSATIONS)
    rows = []
    for form in COMPENSATED:
        both = zip(_worst(simulated[form]), _worst(response(HEAD, w, form)), LIMITS.items(), strict=True)
        for ours, reference, (what, (unit, limit)) in both:
            words = f"{WORDS[form]}: largest error, {what}, 0.1 to 50 rad/s (reference: closed form)"
            key = f"lag-{form}-{what.split()[0]}"
            if form == "angles":
                rows.append(at_most(key, words, ours, unit, limit, reference=reference))
            else:
                rows.append(shown(key, words, ours, unit, reference=reference))
    for pulsation in (8.0, 50.0):
        ours, closed = simulated["raw"].same[PULSATIONS.index(pulsation)], response(HEAD, pulsation, "raw").same
        for what, unit, value in (("amplitude", "1", np.abs), ("phase", "deg", lambda x: np.angle(x, deg=True))):
            words = f"raw: {what} at {pulsation:g} rad/s (reference: closed form)"
            key, reference = f"lag-raw-{what}-{pulsation:g}", float(value(closed))
            rows.append(near(key, words, value(ours), unit, 1e-6 * abs(reference), reference=reference))
    pictures: tuple[tuple[str, str, str, Callable[[Response], FloatArray], bool], ...] = (
        ("amplitude", "Amplitude", "1", lambda r: np.abs(r.same), False),
        ("phase", "Phase", "deg", lambda r: np.degrees(r.phase), False),
        ("error", "Amplitude error", "1", lambda r: np.abs(r.amplitude_error), True),
        ("leak", "Output about the other axis", "1", lambda r: r.leak, True),
    )
    plots = []
    for key, title, unit, value, log in pictures:
        lines = [Line(WORDS[form], dense, value(response(HEAD, dense, form))) for form in FORMS]
        lines += [Line(f"{form}, simulated", w, value(simulated[form]), ".") for form in FORMS]
        plots.append(Plot(f"lag-{key}", title, "rad/s", unit, lines, log=log))
    return rows, plots


def _worst(answer: Response) -> tuple[float, float, float]:
    """Largest amplitude error, %, phase, deg, and leak, %."""
    return (
        100.0 * float(np.abs(answer.amplitude_error).max()),
        math.degrees(float(np.abs(answer.phase).max())),
        100.0 * float(answer.leak.max()),
    )


def _attitude() -> tuple[list[Row], list[Plot]]:
    """Roll by the source's two attitude methods, from raw and from compensated rates."""
    rows: list[Row] = []
    lines: list[Line] = []
    level = np.array([1.0, 0.0, 0.0, 0.0])
    swings = {pulsation: Rocking(math.radians(ROLL_DEG), pulsation) for pulsation in TABLE_1}
    found = {pulsation: outputs(HEAD, signal, RECORD_S) for pulsation, signal in swings.items()}
    for name in METHODS:
        for pulsation, published in TABLE_1.items():
            rate = source_roll(pulsation)[0]
            q = method(name).integrate_rates(level, np.full(len(rate) - 1, STEP_S), rate)
            what = f"{name}, raw rates as the source: amplitude of the roll at {pulsation:g} rad/s"
            ours = amplitude_deg(euler_from_quaternion(q)[:, 2])
            rows.append(near(f"roll-{name}-raw-{pulsation:g}", what, ours, "deg", 0.05, published=published))
        for form in COMPENSATED:
            worst = 0.0
            for pulsation, (edges, axes) in found.items():
                q = method(name).integrate(swings[pulsation].attitude(edges[:1])[0], np.diff(edges), body(axes[form]))
                roll = euler_from_quaternion(q)[:, 2]
                worst = max(worst, abs(amplitude_deg(roll) / ROLL_DEG - 1.0))
            what = f"{name}, {WORDS[form]}: largest error of the amplitude, 0.5 to 8 rad/s"
            rows.append(at_most(f"roll-{name}-{form}", what, 100.0 * worst, "%", 0.01))
    edges, axes = found[8.0]
    part = slice(0, 2000)
    start, time = swings[8.0].attitude(edges[:1])[0], edges[1:][part]
    for form in FORMS:
        q = method(METHODS[1]).integrate(start, np.diff(edges)[part], body(axes[form])[part])
        lines.append(Line(WORDS[form], time, np.degrees(euler_from_quaternion(q)[:, 2])))
    return rows, [Plot("roll", "Roll of 10 deg at 8 rad/s by the Euler vector", "s", "deg", lines)]


def _sensitivity() -> tuple[list[Row], list[Plot]]:
    """Wrong parameters, and noise."""
    w, dense = np.linspace(0.0, 8.0, 81), np.geomspace(0.1, 50.0, 400)
    rows, gain, leak, noise = [], [], [], []
    scaled = ("z on the wire 2 % too large", HEAD)
    for form, key, (what, taken_for), scale in (
        ("increments", "lag", WRONG["lag"], 1.0),
        ("angles", "scale", scaled, LAG_ERROR),
        ("angles", "lag", WRONG["lag"], 1.0),
        ("angles", "damping", WRONG["damping"], 1.0),
    ):
        with_angles = form == "angles"
        slow, fast = (
            compensated_response(HEAD, x, STEP_S, with_angles=with_angles, taken_for=taken_for, angle_scale=scale)
            for x in (w, dense)
        )
        words = f"{WORDS[form]}, {what}"
        error = 100.0 * float(np.abs(slow.amplitude_error).max())
        rows.append(at_most(f"wrong-{form}-{key}", f"{words}: largest amplitude error, 0 to 8 rad/s", error, "%", 1.5))
        gain.append(Line(words, dense, np.abs(fast.amplitude_error)))
        leak.append(Line(words, dense, fast.leak))
    hz = np.geomspace(0.1, 500.0, 400)
    for form in COMPENSATED:
        with_angles = form == "angles"
        of_increments, of_angles = noise_gain(HEAD, STEP_S, with_angles=with_angles)
        spectra = noise_spectrum(HEAD, TURN * hz, STEP_S, with_angles=with_angles)
        sources = (("torquer increments", of_increments, spectra[0]), ("z", of_angles, spectra[1]))
        for source, gains, spectrum in sources[: 2 if with_angles else 1]:
            words = f"{WORDS[form]}, white noise of {source}: "
            key = f"noise-{form}-{source.split()[0]}"
            rows.append(shown(f"{key}-increment", words + "gain to an increment", gains.increment, "1"))
            rows.append(shown(f"{key}-angle", words + "gain to the angle, which does not grow", gains.angle, "1"))
            noise.append(Line(f"{form}: {source}", hz, spectrum))
    return rows, [
        Plot("wrong-amplitude", "Amplitude error of wrong parameters", "rad/s", "1", gain, log=True),
        Plot("wrong-leak", "Leak to the other axis of wrong parameters", "rad/s", "1", leak, log=True),
        Plot("noise", "Noise gain to an increment, 1 kHz", "Hz", "1", noise, log=True),
    ]


def run() -> Study:
    """All of it."""
    rows: list[Row] = []
    plots: list[Plot] = []
    for part in (_tables, _chart, _lag, _attitude, lambda: (roll_rows(WRONG), []), vibration, _sensitivity):
        more_rows, more_plots = part()
        rows += more_rows
        plots += more_plots
    about = (
        "Tables and stability are those of the rotor fitted to the source, integrated as the source did, by RK4 at 1 ms; its "
        "published limits are those of that integrator, not of the gyro. Everything else is the head rotor, stepped exactly at "
        "8 kHz: samples of 1 ms, raw, compensated with the rotor angles, and compensated from the increments alone."
    )
    return Study("dtg", "Dynamically tuned gyro", about, rows, plots)
