"""Sine and cosine of a phase, and polynomials."""

from ..lanes import horner as horner
from ..lanes import sincos as sincos
