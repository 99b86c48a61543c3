"""Sine and cosine of a phase, and polynomials."""

from ..lanes import sincos as sincos


def horner(coefficients: tuple, x):
    """The polynomial with these coefficients (constant term first) at `x`."""
    value = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        value = value * x + coefficient
    return value
