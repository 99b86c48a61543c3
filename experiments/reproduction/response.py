"""Figure 2: smallest and largest Y over ζ, by closed form, by continuation and by sweeps."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.tree_util as jtu
import numpy as np
from tools.ideal import closed_forms, vibration
from vi_jax.flow import jit
from vi_jax.machine import with_leaf
from vi_jax.machines import Scene
from vi_jax.orbit import Branch, ClosedFormOrbits, continue_orbit, find_orbit
from vi_jax.scans import REGIMES, Sweep, lyapunov, sweep

from .motions import GAP, table_damping_ratio

# The values of k in Figure 2, and Table 1's range of ζ.
RESTITUTIONS = (0.8, 0.5)
RANGE = (0.5, 1.9)
# The longest step along its branches, in the units of `continue_orbit`: a choice.
MAX_STEP = 0.2
RATIO, DAMPING, BOUNCE = "drive.frequency_ratio", "damping_ratio", "stops.0.restitution"

# The paper draws a second stop below without a number. At this value the 2π motion does not reach
# it, and most of the motions that the sweeps reach do.
WALL = -2.5
# Between these values the motions change much, and the steps of ζ are finer.
FINE = (0.695, 1.015)
# The longest period that is detected, in cycles: a choice.
LONGEST = 12
# The sweeps of rising and of falling ζ.
DIRECTIONS = "run-up", "close-down"
# Lanes of the programs that settle single values again; a fixed number needs only one program.
_LANES = 128


class System(NamedTuple):
    """The results of Figure 2 for one k and one ξ. Arrays of the sweeps are sorted by ζ."""

    restitution: float
    damping_ratio: float
    closed: dict[int, ClosedFormOrbits]
    """Motions with one impact per 1 and per 2 drive cycles at each ζ (2π and 4π)."""
    branches: list[Branch]
    """The 2π branch, the branch from its period doubling, and those from further grazings."""
    stretch: tuple[float, float]
    """ζ of BB' and CC': first grazing and period doubling of the 2π impact motion."""
    sweeps: dict[str, Sweep]
    """The sweeps by the names in `DIRECTIONS`."""
    exponents: dict[str, np.ndarray]
    """Largest Lyapunov exponent per drive cycle if a sweep has no period, else NaN."""


class Response(NamedTuple):
    """All curves and marks of Figure 2."""

    ratios: np.ndarray
    """The values of ζ of the sweeps, sorted."""
    systems: list[System]
    """For each k of `RESTITUTIONS`, the undamped system and that with Table 1's damping."""


def response() -> Response:
    """Return closed forms, continued branches and both sweeps, for both k and both ξ."""
    low, high = RANGE
    steps = (low, FINE[0], 0.01), (FINE[0], FINE[1] - 0.001, 0.002), (FINE[1], high + 0.005, 0.01)
    ratios = np.concatenate([np.arange(*step) for step in steps])
    scene = Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=GAP, damping_ratio=0.0)
    numbers = [(k, xi) for k in RESTITUTIONS for xi in (0.0, table_damping_ratio())]
    systems = []
    for pair, settled in zip(numbers, _sweeps(scene, numbers, ratios), strict=True):
        points = np.column_stack([ratios, np.tile(pair, (len(ratios), 1))])
        forms = {n: closed_forms(points, n) for n in (1, 2)}
        branches = _branches(_with_numbers(scene, *pair, 0.9), ratios, forms[1])
        systems.append(System(*pair, forms, *branches, *settled))
    return Response(ratios, systems)


def _with_numbers(scene: Scene, k: object, xi: object, ratio: object) -> Any:
    """Return the scene with this k, this ξ and this ζ."""
    for name, value in ((BOUNCE, k), (DAMPING, xi), (RATIO, ratio)):
        scene = with_leaf(scene, name, value)
    return scene


def _branches(
    scene: Scene, ratios: np.ndarray, closed: ClosedFormOrbits
) -> tuple[list[Branch], tuple[float, float]]:
    """Return the 2π branch with those that begin on it, and ζ of BB' and CC'."""
    near = int(np.argmin(abs(ratios - 0.9)))
    orbit = find_orbit(scene, scene.start(Y=closed.Y[near, 0], V=closed.V[near, 0]), throw=True)
    follow = partial(continue_orbit, parameter=RATIO, bounds=RANGE, max_step=MAX_STEP)
    branches = [follow(orbit)]
    born = min(p.parameter for p in branches[0].special if p.kind == "grazing")
    waiting = [p for p in branches[0].special if p.kind == "period-doubling"]
    doubling = max(p.parameter for p in waiting)
    seen: set[float] = set()
    # Each grazing of a doubled motion leads to the next motion; those at or below BB' are skipped.
    while waiting and len(branches) < 4:
        at = waiting.pop()
        try:
            branch = follow(at.switch())
        except ValueError:  # no admissible motion beyond
            continue
        branches.append(branch)
        seen.add(round(at.parameter, 7))
        waiting += [
            p
            for p in branch.special
            if p.kind == "grazing" and p.parameter > born and round(p.parameter, 7) not in seen
        ]
    return branches, (born, doubling)


@partial(jit, static_argnames="settle")
def _carried(scene: Scene, numbers, values, starts, settle: int) -> Sweep:
    """Sweep rows of values of ζ, each with its k and ξ in `numbers` and a start, in one program."""

    def one(numbers, values, start):
        here = _with_numbers(scene, numbers[0], numbers[1], values[0])
        return sweep(
            here, RATIO, values, start=start, settle=settle, cycles=2 * LONGEST, tolerance=1e-9
        )

    return jax.vmap(one)(numbers, values, starts)


@jit
def _exponents(scene: Scene, numbers, values, starts):
    """Return the largest Lyapunov exponents per drive cycle."""

    def one(numbers, value, start):
        here = _with_numbers(scene, numbers[0], numbers[1], value)
        return lyapunov(here, start, 500, settle=0, number=1).per_cycle[0]

    return jax.vmap(one)(numbers, values, starts)


def _sweeps(
    scene: Scene, numbers: list[tuple[float, float]], ratios: np.ndarray
) -> list[tuple[dict[str, Any], ...]]:
    """Return sweeps and exponents of each system by direction, all computed in one program."""
    lanes = [(k, xi, up) for k, xi in numbers for up in (True, False)]
    pairs = np.array([lane[:2] for lane in lanes])
    values = np.stack([ratios if up else ratios[::-1] for *_, up in lanes])
    # Starts on the motion without impacts: without damping, the transient from rest never decays.
    gain = vibration(values[:, 0], pairs[:, 1])
    begin_Y, begin_V = gain.real, (1j * values[:, 0] * gain).real
    starts = jax.vmap(lambda Y, V: scene.start(Y=Y, V=V))(begin_Y, begin_V)
    found = _carried(scene, pairs, values, starts, 120)
    flat = jtu.tree_map(lambda x: np.array(x).reshape(-1, *x.shape[2:]), found)
    pairs, values = np.repeat(pairs, len(ratios), axis=0), values.ravel()
    for _ in range(2):
        unsure = (flat.period == REGIMES.unsettled) | (flat.period > 2)
        _again(scene, flat, pairs, values, np.flatnonzero(unsure))
    exponents = np.full(len(values), np.nan)
    for some in _chunks(np.flatnonzero(flat.period == REGIMES.unsettled)):
        ends = jtu.tree_map(lambda x, some=some: x[some, -1], flat.sections)
        exponents[some] = _exponents(scene, pairs[some], values[some], ends)
    for _ in range(6):  # near a bifurcation motions settle slowly
        quiet = (flat.period == REGIMES.unsettled) & (exponents < 0.002)
        _again(scene, flat, pairs, values, np.flatnonzero(quiet))
    exponents[flat.period > 0] = np.nan

    def part(x: np.ndarray, i: int, j: int) -> np.ndarray:
        x = x.reshape(-1, 2, len(ratios), *x.shape[1:])[i, j]
        return x[::-1] if j else x

    return [
        tuple(
            {name: jtu.tree_map(partial(part, i=i, j=j), of) for j, name in enumerate(DIRECTIONS)}
            for of in (flat, exponents)
        )
        for i in range(len(numbers))
    ]


def _again(scene: Scene, flat: Sweep, pairs: np.ndarray, values: np.ndarray, which) -> None:
    """Settle the values with these indices for another 1,000 cycles; change `flat` in place."""
    for some in _chunks(which):
        ends = jtu.tree_map(lambda x, some=some: x[some, -1], flat.sections)
        later = _carried(scene, pairs[some], values[some][:, None], ends, 1000)

        def put(old, new, some=some):
            old[some] = np.asarray(new)[:, 0]

        jtu.tree_map(put, flat, later)


def _chunks(indices: np.ndarray) -> list[np.ndarray]:
    """Return indices in rows of equal length; the last row repeats its last index."""
    if not indices.size:
        return []
    padded = np.append(indices, np.repeat(indices[-1:], -len(indices) % _LANES))
    return list(padded.reshape(-1, _LANES))
