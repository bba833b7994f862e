"""Motions before two dynamically tuned gyros, and what the head and its compensation make of them."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from nav.attitude import method
from nav.attitude.signals import Signal
from nav.exponential import ComplexArray
from nav.increments import FloatArray, HeadIncrements
from nav.instruments.dtg import Rotor, move, step_map
from nav.instruments.dtg_compensation import LagCompensator
from nav.instruments.dtg_response import Response, compensated_response, raw_response
from nav.rotation import attitude_error

STEP_S = 1e-3
"""Of the head's samples."""
INSIDE = 8
"""Steps of the rotors in a sample."""
SETTLED_S = 20.0
"""The slowest transient of the head rotor, 1.5 1/s, is below 1e-13 then."""
FORMS = ("raw", "angles", "increments")
"""The torquer's increments; compensated with z on the wire; compensated from increments alone."""
DEG_PER_HOUR = math.pi / 648000.0


@dataclass(frozen=True)
class Rocking:
    """A swing ``amplitude sin(pulsation t)`` about x: a `nav.attitude.signals.Signal`; rad, rad/s."""

    amplitude: float
    pulsation: float

    def _angle(self, time: ArrayLike) -> FloatArray:
        return np.asarray(self.amplitude * np.sin(self.pulsation * np.asarray(time, np.float64)))

    def attitude(self, time: ArrayLike) -> FloatArray:
        """As `Signal.attitude`."""
        half = 0.5 * self._angle(time)
        return np.stack([np.cos(half), np.sin(half), 0.0 * half, 0.0 * half], axis=-1)

    def rate(self, time: ArrayLike) -> FloatArray:
        """As `Signal.rate`."""
        swing = self.amplitude * self.pulsation * np.cos(self.pulsation * np.asarray(time, np.float64))
        return np.stack([swing, 0.0 * swing, 0.0 * swing], axis=-1)

    def increments(self, edges: ArrayLike) -> FloatArray:
        """As `Signal.increments`."""
        turned = np.diff(self._angle(edges))
        return np.stack([turned, 0.0 * turned, 0.0 * turned], axis=-1)


def outputs(
    rotor: Rotor, signal: Signal, duration: float, taken_for: Rotor | None = None
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """What a head with two such gyros, and the compensation, make of a motion after the transients of its start.

    Returns
    -------
    edges : (n + 1,) float
        Ends of the steps, s.
    increments : dict of (n, 4) float
        Of g1x, g1y, g2y, g2z, rad, by the names of `FORMS`.
    """
    step = STEP_S / INSIDE
    inner = np.asarray(np.arange(round((SETTLED_S + duration) / STEP_S) * INSIDE + 1) * step, np.float64)
    rate, mean = signal.rate(inner), signal.increments(inner) / step
    change = np.diff(rate, axis=0)
    head = HeadIncrements.empty(len(mean) // INSIDE)
    head.step[:], head.sequence[:] = STEP_S, np.arange(len(head))
    table, angle, swept = step_map(rotor, step), np.empty((len(mean), 2)), np.empty((len(mean), 2))
    for x, y, columns in ((0, 1, slice(0, 2)), (1, 2, slice(2, 4))):
        state = rotor.settled((rate[0, x], rate[0, y]))
        move(table, state, mean[:, (x, y)], change[:, (x, y)], angle, swept)
        head.dtheta[:, columns] = -swept.reshape(-1, INSIDE, 2).sum(axis=1) / rotor.lag
        head.rotor[:, columns] = angle[INSIDE - 1 :: INSIDE]
    first = round(SETTLED_S / STEP_S)
    found = {"raw": head.dtheta}
    for form, rotors in (("angles", head.rotor), ("increments", np.full_like(head.rotor, np.nan))):
        found[form] = np.empty_like(head.dtheta)
        compensator = LagCompensator(taken_for or rotor, taken_for or rotor)
        compensator.compensate(replace(head, rotor=rotors), found[form])
    return inner[first * INSIDE :: INSIDE], {form: axes[first:] for form, axes in found.items()}


def body(axes: FloatArray) -> FloatArray:
    """Increments (n, 3) of the four axes (n, 4), the two of y averaged."""
    return np.column_stack([axes[:, 0], 0.5 * (axes[:, 1] + axes[:, 2]), axes[:, 3]])


def response(rotor: Rotor, pulsation: ArrayLike, form: str, taken_for: Rotor | None = None) -> Response:
    """Closed form of a form's answer."""
    if form == "raw":
        return raw_response(rotor, pulsation)
    return compensated_response(rotor, pulsation, STEP_S, with_angles=form == "angles", taken_for=taken_for)


def simulated_responses(rotor: Rotor, pulsations: Iterable[float]) -> dict[str, Response]:
    """The answers measured in the simulation, by form."""
    found: dict[str, list[tuple[complex, complex]]] = {form: [] for form in FORMS}
    for pulsation in pulsations:
        signal = Rocking(1.0, pulsation)
        edges, forms = outputs(rotor, signal, max(1.0, 4.0 * math.pi / pulsation))
        wave = np.exp(1j * pulsation * 0.5 * (edges[1:] + edges[:-1]))
        true = _phasor(wave, signal.increments(edges)[:, 0])
        for form, axes in forms.items():
            found[form].append((_phasor(wave, axes[:, 0]) / true, _phasor(wave, axes[:, 1]) / true))
    return {form: Response(*np.array(both).T) for form, both in found.items()}


def _phasor(wave: ComplexArray, value: FloatArray) -> complex:
    (a, b), *_ = np.linalg.lstsq(np.column_stack([wave.real, -wave.imag]), value, rcond=None)
    return complex(a, b)


def drift_deg_h(signal: Signal, pulsation: float, edges: FloatArray, axes: FloatArray) -> float:
    """Rate at which the attitude from the four axes leaves that from the true increments, in a motion of this period."""
    blocks = method("high-order:8")
    start, step = signal.attitude(edges[:1])[0], np.diff(edges)
    q, q_true = (blocks.block_ends(start, step, dtheta) for dtheta in (body(axes), signal.increments(edges)))
    time = edges[blocks.block :: blocks.block][: len(q)]
    error = attitude_error(q, q_true)
    waves = [f(k * pulsation * time) for k in (1, 2, 3) for f in (np.cos, np.sin)]
    fit, *_ = np.linalg.lstsq(np.column_stack([time - time[0], np.ones_like(time), *waves]), error, rcond=None)
    return float(np.linalg.norm(fit[0])) / DEG_PER_HOUR


def rectified_deg_h(answer: Response, rate: ComplexArray, pulsation: ArrayLike) -> FloatArray:
    """The same in closed form, to the square of the angle: (1/4) Im(m x m* - w x w*) / W.

    Parameters
    ----------
    answer : Response
        Of both gyros, over (n,) frequencies.
    rate : (n, 3) complex
        w: the motion as Re(w exp(j W t)), rad/s; m is what the head makes of it.
    pulsation : (n,) float
        W, rad/s.
    """
    s, c = answer.same, answer.cross
    x, y, z = rate.T
    measured = np.column_stack([s * x - c * y, s * y + 0.5 * c * (x - z), s * z + c * y])
    turn = [np.cross(value, np.conj(value)).imag for value in (measured, rate)]
    drift: FloatArray = np.linalg.norm(turn[0] - turn[1], axis=1) / (4.0 * np.asarray(pulsation)) / DEG_PER_HOUR
    return drift
