"""Dormand–Prince 5(4), written for numba: scalars in registers, one lane after the other.

It uses first-same-as-last and proportional-integral step control. After an impact it restarts with
the last step size. Events are located on the dense output of fourth order (a further step to the
event was no more accurate). Sine and cosine are polynomials, and multiplications may fuse with
additions: together 30 % faster than the mathematical library without fusing. No other fast-math
flag is set.
"""

import math
import time
from typing import Any

import numba as nb  # pyright: ignore[reportMissingImports]
import numpy as np

from .task import Run, Task

OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}}
INLINE: dict[str, Any] = {**OPTIONS, "inline": "always"}

_C = tuple((-1) ** n / math.factorial(2 * n) for n in range(9))
_S = tuple((-1) ** n / math.factorial(2 * n + 1) for n in range(8))


@nb.njit(**INLINE)
def sincos(phase):
    """Return sine and cosine on [0, 2π]: series on a quarter of the argument, doubled twice."""
    x = 0.25 * (phase - math.pi)
    z = x * x
    s = _S[5] + z * (_S[6] + z * _S[7])
    s = x * (_S[0] + z * (_S[1] + z * (_S[2] + z * (_S[3] + z * (_S[4] + z * s)))))
    c = _C[5] + z * (_C[6] + z * (_C[7] + z * _C[8]))
    c = _C[0] + z * (_C[1] + z * (_C[2] + z * (_C[3] + z * (_C[4] + z * c))))
    s2, c2 = 2 * s * c, 1 - 2 * s * s
    return -2 * s2 * c2, 2 * s2 * s2 - 1


@nb.njit(**INLINE)
def motor_field(s, y, p):
    """Return d(Y, V, W)/dφ; `p` holds κ, ξ, τ0, ε, μ."""
    sine, cosine = sincos(s)
    inertia = 1 + p[4] * sine * sine
    share = 1 / (y[2] * inertia)
    pace = inertia * share
    torque = p[2] * (p[0] - y[2]) - p[3] * sine * (y[0] - cosine) - p[4] * sine * cosine * y[2] ** 2
    return y[1] * pace, (cosine - y[0] - 2 * p[1] * y[1]) * pace, torque * share


@nb.njit(**INLINE)
def ideal_field(s, y, p):
    """Return d(Y, V)/dφ; `p` holds 1/ζ, ξ."""
    _, cosine = sincos(s)
    return y[1] * p[0], (cosine - y[0] - 2 * p[1] * y[1]) * p[0]


@nb.njit(**INLINE)
def add3(y, a, k):
    """Return y + a k."""
    return y[0] + a * k[0], y[1] + a * k[1], y[2] + a * k[2]


@nb.njit(**INLINE)
def add2(y, a, k):
    """Return y + a k."""
    return y[0] + a * k[0], y[1] + a * k[1]


@nb.njit(**INLINE)
def bounce3(y, gap, k):
    """Return the state after an impact."""
    return gap, -k * y[1], y[2]


@nb.njit(**INLINE)
def bounce2(y, gap, k):
    """Return the state after an impact."""
    return gap, -k * y[1]


@nb.njit(**INLINE)
def part(e, a, b, tol):
    """Return one squared component of the error norm."""
    scaled = e / (tol * (1 + max(abs(a), abs(b))))
    return scaled * scaled


@nb.njit(**INLINE)
def norm3(e, a, b, tol):
    """Return the root mean square over the components, relative to the tolerance."""
    total = part(e[0], a[0], b[0], tol) + part(e[1], a[1], b[1], tol) + part(e[2], a[2], b[2], tol)
    return math.sqrt(total / 3)


@nb.njit(**INLINE)
def norm2(e, a, b, tol):
    """Return the root mean square over the components, relative to the tolerance."""
    return math.sqrt((part(e[0], a[0], b[0], tol) + part(e[1], a[1], b[1], tol)) / 2)


@nb.njit(**INLINE)
def dense(th, r1, r2, r3, r4, r5):
    """Return the dense output of one component at a fraction of the step."""
    u = 1 - th
    return r1 + th * (r2 + u * (r3 + th * (r4 + u * r5)))


@nb.njit(**INLINE)
def dense_rate(th, r2, r3, r4, r5):
    """Return the derivative of the dense output."""
    u = 1 - th
    return r2 + (u - th) * r3 + th * (2 * u - th) * r4 + 2 * th * u * (u - th) * r5


@nb.njit(**INLINE)
def hump(y, gap, r2, r3, r4, r5):
    """Return the fraction of the step at which the body turns beyond the stop, or 0."""
    low, high = 0.0, 1.0
    for _ in range(30):
        th = 0.5 * (low + high)
        if dense_rate(th, r2, r3, r4, r5) > 0:
            low = th
        else:
            high = th
    if dense(low, y, r2, r3, r4, r5) <= gap:
        return 0.0
    return low


@nb.njit(**INLINE)
def crossing(top, y, rate, gap, r2, r3, r4, r5):
    """Return the fraction of the step, below `top`, at which the body meets the stop.

    Newton's method is safeguarded by bisection; `rate` is the rate at the beginning of the step.
    """
    low, high = 0.0, top
    th = 0.5 * top
    if rate > 0:
        th = min(0.999 * top, max(1e-3 * top, (gap - y) / rate))
    for _ in range(40):
        over = dense(th, y, r2, r3, r4, r5) - gap
        slope = dense_rate(th, r2, r3, r4, r5)
        if over < 0 or slope <= 0:
            low = th
        else:
            high = th
        new = th - over / slope
        if not (new > low and new < high):
            new = 0.5 * (low + high)
        moved, th = abs(new - th), new
        if moved < 1e-15:
            break
    return th


def stepper(field: Any, add: Any, bounce: Any, norm: Any) -> Any:
    """Return the compiled integrator of one lane with one kind of drive."""

    @nb.njit(**OPTIONS)
    def lane(y, p, k, gap, cycles, tol):
        turn = 2 * math.pi
        s, proposed, old, done = 0.0, 0.05, 1e-4, 0
        k1 = field(s, y, p)
        while done < cycles:
            h, last = proposed, False
            if s + h >= turn:
                h, last = turn - s, True
            k2 = field(s + h / 5, add(y, h / 5, k1), p)
            k3 = field(s + 0.3 * h, add(add(y, h * 3 / 40, k1), h * 9 / 40, k2), p)
            z = add(add(add(y, h * 44 / 45, k1), h * -56 / 15, k2), h * 32 / 9, k3)
            k4 = field(s + 0.8 * h, z, p)
            z = add(add(y, h * 19372 / 6561, k1), h * -25360 / 2187, k2)
            z = add(add(z, h * 64448 / 6561, k3), h * -212 / 729, k4)
            k5 = field(s + h * 8 / 9, z, p)
            z = add(add(y, h * 9017 / 3168, k1), h * -355 / 33, k2)
            z = add(add(add(z, h * 46732 / 5247, k3), h * 49 / 176, k4), h * -5103 / 18656, k5)
            k6 = field(s + h, z, p)
            y1 = add(add(y, h * 35 / 384, k1), h * 500 / 1113, k3)
            y1 = add(add(add(y1, h * 125 / 192, k4), h * -2187 / 6784, k5), h * 11 / 84, k6)
            k7 = field(s + h, y1, p)
            e = add(add(add(y1, -1.0, y1), h * 71 / 57600, k1), h * -71 / 16695, k3)
            e = add(add(e, h * 71 / 1920, k4), h * -17253 / 339200, k5)
            error = norm(add(add(e, h * 22 / 525, k6), h * -1 / 40, k7), y, y1, tol)
            if error > 1:
                proposed = h * max(0.2, 0.9 * error**-0.2)
                continue
            top = 0.0
            if y1[0] > gap:
                top = 1.0
            elif k1[0] > 0 and k7[0] < 0 and max(y[0] + h * k1[0] / 2, y1[0] - h * k7[0] / 2) > gap:
                top = 2.0  # a maximum within the step may be beyond the stop
            r2 = r3 = r4 = r5 = k1
            if top > 0:
                r2 = add(y1, -1.0, y)
                r3 = add(add(y, h, k1), -1.0, y1)
                r4 = add(add(r2, -h, k7), -1.0, r3)
                r5 = add(add(r2, -1.0, r2), h * (-12715105075 / 11282082432), k1)
                r5 = add(r5, h * (87487479700 / 32700410799), k3)
                r5 = add(r5, h * (-10690763975 / 1880347072), k4)
                r5 = add(r5, h * (701980252875 / 199316789632), k5)
                r5 = add(r5, h * (-1453857185 / 822651844), k6)
                r5 = add(r5, h * (69997945 / 29380423), k7)
                if top > 1:
                    top = hump(y[0], gap, r2[0], r3[0], r4[0], r5[0])
            if top > 0:
                th = crossing(top, y[0], h * k1[0], gap, r2[0], r3[0], r4[0], r5[0])
                u = 1 - th
                z = add(add(y, th, r2), th * u, r3)
                y = bounce(add(add(z, th * th * u, r4), th * th * u * u, r5), gap, k)
                s += th * h
                k1 = field(s, y, p)
                continue
            factor = min(10.0, max(0.2, 0.9 * max(error, 1e-8) ** -0.17 * old**0.04))
            old = max(error, 1e-4)
            if factor < 1 or not last:
                proposed = h * factor
            y, k1 = y1, k7
            s += h
            if last:
                s = 0.0
                done += 1
        return y

    return lane


motor_lane = stepper(motor_field, add3, bounce3, norm3)
ideal_lane = stepper(ideal_field, add2, bounce2, norm2)


def _motor(kappas, Y0, xi, tau0, eps, mu, k, gap, cycles, tol):
    final = np.empty((len(kappas), 2))
    for i in range(len(kappas)):
        kappa = kappas[i]
        p = (kappa, xi, tau0, eps, mu)
        y = motor_lane((Y0, 0.0, kappa), p, k, gap, cycles, tol)
        final[i, 0], final[i, 1] = y[0], y[1]
    return final


def _ideal(kappas, Y0, xi, tau0, eps, mu, k, gap, cycles, tol):
    final = np.empty((len(kappas), 2))
    for i in range(len(kappas)):
        y = ideal_lane((Y0, 0.0), (1 / kappas[i], xi), k, gap, cycles, tol)
        final[i, 0], final[i, 1] = y[0], y[1]
    return final


_calls = {True: nb.njit(**OPTIONS)(_motor), False: nb.njit(**OPTIONS)(_ideal)}


def build(task: Task, kappas: np.ndarray, *, tol: float) -> tuple[Run, float]:
    """Build the lanes."""
    call = _calls[task.motor]

    def run(cycles: int = task.cycles) -> np.ndarray:
        numbers = (task.Y0, task.xi, task.tau0, task.eps, task.mu, task.k, task.gap)
        return call(kappas, *numbers, cycles, tol)

    begin = time.perf_counter()
    run(0)
    return run, time.perf_counter() - begin
