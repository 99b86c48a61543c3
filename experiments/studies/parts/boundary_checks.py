"""What `boundaries.py` checks of its curves, by the closed form and by simulations beside them."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from matplotlib.path import Path as Polygon
from tools.ideal import GAP, closed_forms, machine, vibration
from tools.study import QUICK
from vi_jax.paper.boundaries import BoundaryCurves, birth_without_damping, plane_points, xi_per_c

# How far beside a curve to simulate, in plane units: 1 in k and c is as long as 0.34 in ζ.
ASIDE, SPANS = 0.006, np.array([0.34, 1.0])
BESIDE, SETTLE = (6, 1000) if QUICK else (12, 4000)


def numbers(plane: str, points: np.ndarray) -> np.ndarray:
    """(ζ, k, ξ) of points of the plane (ζ, k), without damping, or (ζ, c), with k = 0.5."""
    zeta, other = points.T
    if plane == "k":
        return np.stack([zeta, other, np.zeros_like(zeta)], axis=1)
    return np.stack([zeta, np.full_like(zeta, 0.5), other * xi_per_c()], axis=1)


class Curve(NamedTuple):
    name: str
    plane: str
    points: np.ndarray
    cycles: int
    """Period of the motion that the curve is about."""
    kind: str


def checked(curves: BoundaryCurves) -> list[Curve]:
    """The curves that there are, and the line of the birth in (ζ, k)."""
    levels = np.linspace(0.05, 0.95, 40)
    line = np.stack([np.full(40, birth_without_damping(curves)), levels], axis=1)
    found = [Curve("2π birth", "k", line, 1, "birth")]
    for field, name, cycles, kind in (
        ("doubling_k", "2π period doubling", 1, "doubling"),
        ("fold_k", "2π fold", 1, "fold"),
        ("touch_k", "4π touch", 2, "touch"),
        ("long_doubling_k", "4π period doubling", 2, "doubling"),
        ("birth_c", "2π birth", 1, "birth"),
        ("doubling_c", "2π period doubling", 1, "doubling"),
        ("fold_c", "2π fold", 1, "fold"),
        ("touch_c", "4π touch", 2, "touch"),
    ):
        curve = getattr(curves, field)
        if curve is not None:
            found.append(Curve(name, field[-1], plane_points(curve), cycles, kind))
    return found


def miss(curve: Curve) -> float:
    """How far the curve is from what it should be, at worst, by the closed form."""
    # Towards k = 1 at ζ = 1 the free motion is all but resonant, and digits go.
    x = numbers(curve.plane, curve.points)
    x = x[x[:, 1] < 0.99]
    if curve.kind == "birth":
        return float(np.max(np.abs(np.abs(vibration(x[:, 0], x[:, 2])) - GAP)))
    if curve.kind == "fold":
        # Beyond the fold by 1e-6 in ζ there is nothing, before it there are two motions.
        steps = [
            np.sum(closed_forms(x + np.array([s, 0, 0]), 1).exists, axis=1) for s in (-1e-6, 1e-6)
        ]
        return 1e-6 if np.all(steps[0] == 2) and np.all(steps[1] == 0) else np.inf
    found = closed_forms(x, curve.cycles)
    if curve.kind == "doubling":
        return float(np.max(np.nanmin(np.abs(found.multipliers + 1), axis=(1, 2))))
    return float(np.max(np.nanmin(np.abs(found.clearance), axis=1)))


@vi.jit
def settle_all(x: jax.Array, Y: jax.Array, V: jax.Array) -> tuple[jax.Array, ...]:
    """Period and impacts in it of what each start settles on, and impacts in four cycles."""

    def one(lane):
        x, Y, V = lane
        there = machine(*x)
        start = there.start(Y=Y, V=V)
        early = vi.simulate(there, start, 4, method=vi.ExactFlight())
        late = vi.sweep(
            there, "drive.frequency_ratio", x[:1], start=start, settle=SETTLE, cycles=32,
            method=vi.ExactFlight(),
        )  # fmt: skip
        return late.period[0], late.impacts[0], jnp.sum(early.impacts)

    return jax.lax.map(one, (x, Y, V), batch_size=256)


class Start(NamedTuple):
    x: np.ndarray
    Y: np.ndarray
    V: np.ndarray
    stays: np.ndarray
    """Whether the curve says that the motion is there and stable (at a touch: is there)."""


def beside(curve: Curve) -> Start:
    """Starts on both sides of a curve, and what the curve says of them.

    Disturbed towards smaller Y: the section may lie close to the stop, and a start beyond it is
    none.
    """
    points = curve.points
    along = np.gradient(points / SPANS, axis=0)
    keep = np.linalg.norm(along, axis=1) > 0
    if curve.kind == "touch" or curve.cycles == 2:
        # Where the two sides are not yet at the edge of the plane, nor past the next curve.
        keep &= (points[:, 0] < 0.98) & (points[:, 1] > 0.01)
    keep &= (points[:, 1] < 0.97) | (curve.plane == "c")
    keep &= (points[:, 1] > 0.01) & (points[:, 0] < 1.85)
    length = np.cumsum(np.linalg.norm(along, axis=1))
    places = np.linspace(length[keep][0], length[keep][-1], BESIDE)
    chosen = np.flatnonzero(keep)[np.argmin(np.abs(length[keep] - places[:, None]), axis=1)]
    across = along[chosen] @ np.array([[0.0, -1.0], [1.0, 0.0]])
    across *= np.sign(across[:, :1]) * ASIDE / np.linalg.norm(across, axis=1, keepdims=True)
    left, right = points[chosen] - across * SPANS, points[chosen] + across * SPANS
    both = np.concatenate([left, right])
    x, on_right = numbers(curve.plane, both), np.repeat([False, True], len(left))
    if curve.kind == "birth":
        gain = vibration(x[:, 0], x[:, 2])
        # Without damping it is highest on the section itself, and must not begin in the stop.
        Y = np.minimum(gain.real, GAP - 1e-6)
        return Start(x, Y, (1j * x[:, 0] * gain).real, ~on_right)
    motion: Any = closed_forms(x, curve.cycles)
    Y, V = motion.Y[:, 0].copy(), motion.V[:, 0].copy()
    if curve.cycles == 2:
        inside = Polygon(points / SPANS).contains_points(both / SPANS)
        if curve.kind == "touch":  # inadmissible motions come by speed: take the same one
            nearest = np.nanargmin(np.abs(motion.clearance), axis=1)
            Y, V = (np.take_along_axis(a, nearest[:, None], 1)[:, 0] for a in (motion.Y, motion.V))
            return Start(x, Y, V, inside)
        return Start(x, Y - 1e-4, V, ~inside)
    if curve.kind == "fold":  # beyond it nothing is there to begin on but what was before it
        Y[on_right], V[on_right] = Y[~on_right], V[~on_right]
        return Start(x, Y - 1e-4, V, ~on_right)
    return Start(x, Y - 1e-3, V, on_right)
