"""A body between a shaker and a stop in 40 digits: Y'' + 2ξ Y' + Y = cos(ζ τ), Y ≤ d.

Steps are Taylor series, roots are found by Newton's method. The library is not used.
"""

import math
from decimal import Decimal, localcontext

_ORDER, _STEP, _TINY = 44, Decimal("0.25"), Decimal("1e-30")


def rests_again(zeta, k, d, xi):
    """Return whether the body, just released by its stop, chatters to rest on it before the force
    on it changes sign again."""
    with localcontext(prec=45):
        return _rests_again(*(Decimal(str(x)) for x in (zeta, k, d, xi)))


def _rests_again(zeta, k, d, xi):
    y, v, cos, sin, on_stop = d, Decimal(0), d, (1 - d * d).sqrt(), False
    clock = Decimal(0)
    while zeta * clock < Decimal(math.tau):
        pressed, fading = cos - d, zeta * sin  # contact force of a body at rest, and its decay rate
        if on_stop and pressed <= 0:
            return False
        if on_stop and fading > 0 and -v * fading < Decimal("0.005") * pressed**2:
            return True  # chatter needs less than 4 % of the remaining time
        Y, C, S = _series(zeta, xi, y, v, cos, sin)
        room = [Y[0] - d, *Y[1:]]
        if on_stop:
            met = _first(room[1:], 2 * Y[1] / -(2 * Y[2]))
        else:
            met = _first(room, _STEP / 2) if _value(room, _STEP) >= 0 else None
        on_stop, step = met is not None, _STEP if met is None else met
        y, v, cos, sin = _value(Y, step), _slope(Y, step), _value(C, step), _value(S, step)
        clock += step
        if on_stop:
            y, v = d, -k * v
    return False


def _series(zeta, xi, y, v, cos, sin):
    Y, C, S = [y, v], [cos], [sin]
    for i in range(_ORDER):
        Y.append((C[i] - Y[i] - 2 * xi * (i + 1) * Y[i + 1]) / ((i + 1) * (i + 2)))
        C.append(-zeta * S[i] / (i + 1))
        S.append(zeta * C[i] / (i + 1))
    return Y, C, S


def _value(series, x):
    total = Decimal(0)
    for a in reversed(series):
        total = total * x + a
    return total


def _slope(series, x):
    return _value([i * a for i, a in enumerate(series)][1:], x)


def _first(series, x):
    """Return the root near x, or `None` if it is not within a step."""
    if not 0 < x < _STEP:
        return None
    for _ in range(60):
        slope = _slope(series, x)
        move = _value(series, x) / slope if slope else None
        if slope <= 0 or not 0 < x - move < _STEP:
            return None
        x -= move
        if abs(move) < _TINY * x:
            return x
    raise ArithmeticError("no root")
