"""Quantiles of chi-square, for gates and bounds."""

import math
from statistics import NormalDist


def quantile(probability: float, freedom: int) -> float:
    """The value that chi-square stays below with `probability`.

    Of 1, 2 or 3 degrees of freedom exact; of more by Wilson & Hilferty, within 4 per cent up to 1 - 1e-6 from 6 of them on.
    """
    if freedom == 1:
        return NormalDist().inv_cdf(0.5 + 0.5 * probability) ** 2
    if freedom == 2:
        return -2.0 * math.log1p(-probability)
    if freedom > 3:
        share = 2.0 / (9.0 * freedom)
        return freedom * (1.0 - share + NormalDist().inv_cdf(probability) * math.sqrt(share)) ** 3
    x = -2.0 * math.log1p(-probability) + 2.0
    for _ in range(20):  # Newton on F = erf sqrt(x / 2) - 2 p(x), p the density
        density = math.sqrt(x / (2.0 * math.pi)) * math.exp(-0.5 * x)
        x -= (math.erf(math.sqrt(0.5 * x)) - 2.0 * density - probability) / density
    return x
