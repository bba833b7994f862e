"""What linear systems make of a constant and of a linear input: functions phi_k of their eigenvalues.

phi_0 is the exponential and phi_k(x) = 1/k! + x phi_(k+1)(x); phi_1 is the answer to a constant, phi_2 to a ramp, and
phi_3 the integral of that. For a 2 x 2 matrix N with eigenvalues a and b, phi_k(N) = phi_k(a) + phi_k[a, b] (N - a).
"""

import math

import numpy as np
from numpy.typing import NDArray

ComplexArray = NDArray[np.complex128]
ORDERS = 4
"""phi_0 .. phi_3."""
_TERMS = 22
"""Of the series: exact for arguments up to 1."""


def exponential_integrals(x: complex) -> list[complex]:
    """phi_0 .. phi_3 at x."""
    if abs(x) < 1.0:
        return [sum(x**i / math.factorial(i + k) for i in range(_TERMS)) for k in range(ORDERS)]
    values = [complex(np.exp(x))]
    for k in range(ORDERS - 1):
        values.append((values[k] - 1.0 / math.factorial(k)) / x)
    return values


def exponential_differences(a: complex, b: complex) -> list[complex]:
    """Divided differences phi_0[a, b] .. phi_3[a, b], the derivatives where a = b; b is not the smaller."""
    if abs(b) < 1.0:
        power = homogeneous = 1.0 + 0.0j  # b^i, and the sum over m of a^m b^(i - m)
        values = [0.0j] * ORDERS
        for i in range(_TERMS):
            values = [value + homogeneous / math.factorial(i + k + 1) for k, value in enumerate(values)]
            power *= b
            homogeneous = a * homogeneous + power
        return values
    half = 0.5 * (b - a)
    sinhc = np.sinh(half) / half if abs(half) > 1e-3 else 1.0 + half * half / 6.0 * (1.0 + half * half / 20.0)
    values, at_a = [complex(np.exp(0.5 * (a + b)) * sinhc)], exponential_integrals(a)
    for k in range(ORDERS - 1):
        values.append((values[k] - at_a[k + 1]) / b)
    return values
