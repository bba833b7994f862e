"""The phi functions and their divided differences, far from and at coincidence."""

import cmath

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.linalg import expm

from nav.exponential import ORDERS, exponential_differences, exponential_integrals

argument = st.complex_numbers(max_magnitude=30.0, allow_nan=False).filter(lambda x: x.real < 5.0)


def by_matrix(x):
    """phi_k(x) is the corner of the exponential of a Jordan chain: x, then k zeros."""
    chain = np.diag(np.ones(ORDERS, complex), 1)
    chain[0, 0] = x
    return expm(chain)[0, :ORDERS]


@given(argument)
@example(0j)
@example(1.0 + 0j)
@example(0.9999999 + 0j)
def test_integrals(x):
    np.testing.assert_allclose(exponential_integrals(x), by_matrix(x), rtol=1e-12, atol=1e-13)


@given(argument, argument)
def test_differences(a, b):
    a, b = sorted((a, b), key=abs)
    if abs(a - b) > 0.1:
        expected = (by_matrix(b) - by_matrix(a)) / (b - a)
        np.testing.assert_allclose(exponential_differences(a, b), expected, rtol=1e-10, atol=1e-11)


@pytest.mark.parametrize("x", [0j, 0.3 + 0.4j, -1.5 + 0.2j, 20j])
@pytest.mark.parametrize("distance", [0.0, 1e-13, 1e-8, 1e-5, 3e-3])
def test_differences_of_near_values_go_over_into_derivatives(x, distance):
    """Around x the difference of the exponential is exp(x) (1 + O(distance^2)); phi_k follows by its recursion."""
    a, b = sorted((x - distance / 2, x + distance / 2), key=abs)
    found = exponential_differences(a, b)
    assert found[0] == pytest.approx(cmath.exp(x) * (1.0 + distance**2 / 24.0), rel=1e-13)
    at_a = exponential_integrals(a)
    for k in range(ORDERS - 1):
        assert found[k] == pytest.approx(at_a[k + 1] + b * found[k + 1], rel=1e-13, abs=1e-14)
