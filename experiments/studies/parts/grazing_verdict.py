"""Classify by simulation what follows a grazing: the judge of `grazing_forecast.py`.

It uses no local map. Lanes on both sides of the grazing begin at the state of the motion that
grazes, each with another value of the parameter, and run for `SETTLE` cycles and `WATCHED` more.
"""

import contextlib
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi

from .grazing_machines import changed, is_soft, number

LANES, SETTLE, WATCHED, LONGEST = 192, 1000, 128, 40
METHOD = vi.FixedStep(vi.Verner9(), steps_per_cycle=48)

# Sections that differ by less than this share of what they span repeat; and by less than this
# altogether, where rounding decides.
_REPEATS, _ROUNDING = 1e-3, 1e-11

# The size of a motion that begins at the grazing rises with a power of the distance from it in the
# parameter (1/2 for a rigid stop): the least power that counts.
_GROWS = 0.15

# A lane so many times farther away than others, over the root of its offset, has left.
_LEFT = 10.0

# Shares of lanes without a period below which windows lie next to each other, and above which there
# is chaos alone; and of lanes with period 1 above which the motion persists.
_FEW, _ALL = 0.02, 0.96

# Starts of the search for a motion with one touch more; how far they are, over the offset in the
# parameter; how many are gone on from, and how often.
_STARTS, _REACH, _BEST, _ROUNDS = 8192, (0.1, 300.0), 256, 14


class Lanes(NamedTuple):
    """What lanes do, each at its offset of the parameter; positive offsets on the impacts' side."""

    offset: np.ndarray
    distance: np.ndarray
    """From the motion that grazes, the largest on a section."""
    period: np.ndarray
    """0 without one."""
    touches: np.ndarray
    """In a period, beyond those of the motion that grazes; NaN without a period."""
    side: int
    """In which sense of the parameter there are more touches."""


@jax.jit(static_argnames="name")
def _swept(machine: Any, name: str, values: Any, state: Any) -> tuple[Any, Any, Any]:
    """Sections, touches and whether it was followed, of each value."""

    def one(value):
        there = changed(machine, name, value)
        run = vi.simulate(
            there, state, WATCHED, settle=SETTLE, method=METHOD,
            record="motion" if is_soft(there) else "sections",
        )  # fmt: skip
        hits = run.y_max > there.stop.gap if is_soft(there) else run.impacts
        return jnp.stack(jax.tree.leaves(run.sections), axis=-1)[1:], hits, run.successful

    return jax.vmap(one)(values)


def swept(point: vi.Point, name: str, low: float, high: float, seed: int) -> Lanes:
    """Lanes on both sides of a grazing, their offsets at random between two sizes of it (evenly
    spread by their logarithm), told apart by where there are more touches."""
    rng = np.random.default_rng(seed)
    size = np.sort(np.exp(rng.uniform(np.log(low), np.log(high), LANES)))
    machine = point.orbit.machine
    start = jax.tree.map(jnp.asarray, point.orbit.state)
    at = np.concatenate([point.parameter + size, point.parameter - size])
    rows, hits, good = map(np.asarray, _swept(machine, name, jnp.asarray(at), start))
    more = hits - _base(point)
    side = 1 if _goes_on(point, name, -size) >= _goes_on(point, name, size) else -1
    part = slice(LANES) if side > 0 else slice(LANES, None)
    rows, more, good = rows[part], more[part], good[part]
    distance = np.where(good, np.abs(rows - _origin(point)).max(axis=(1, 2)), np.inf)
    period = np.where(
        good, [_period(r, m, d) for r, m, d in zip(rows, more, distance, strict=True)], 0
    )
    touches = [m[-p:].sum() if p else np.nan for p, m in zip(period, more, strict=True)]
    return Lanes(size, distance, period, np.array(touches, float), side)


def _goes_on(point: vi.Point, name: str, offsets: np.ndarray) -> int:
    """At how many of some values there is, near the motion that grazes, one with its touches."""
    some = offsets[:: LANES // 8]
    many, starts = _beside(point, name, some, np.tile(_origin(point), (len(some), 1)))
    _, hits, good = map(np.asarray, _searched(many, starts))
    return int((good & (hits == _base(point))).sum())


def _period(rows: np.ndarray, more: np.ndarray, distance: float) -> int:
    """The least period of a lane, or 0."""
    span = np.ptp(rows, axis=0).max()
    for p in range(1, LONGEST + 1):
        apart = np.abs(rows[p:] - rows[:-p]).max()
        whole = distance if p == 1 else span
        if (more[p:] == more[:-p]).all() and apart <= max(_REPEATS * whole, _ROUNDING):
            return p
    return 0


@jax.jit
@jax.vmap
def _cycled(machine: Any, start: Any) -> tuple[Any, Any]:
    """By how much a motion misses its start after a cycle, and its touches."""
    run = vi.simulate(
        machine, start, 1, method=METHOD, record="motion" if is_soft(machine) else "sections"
    )
    ends = jnp.stack(jax.tree.leaves(run.sections))
    hits = (run.y_max > machine.stop.gap) if is_soft(machine) else run.impacts
    miss = jnp.abs(ends[:, 1] - ends[:, 0]).max()
    return jnp.where(run.successful, miss, jnp.inf), hits[0]


@jax.jit
@jax.vmap
def _searched(machine: Any, start: Any) -> tuple[Any, Any, Any]:
    """State, touches and whether it was found, of the motion of one cycle near a start."""
    orbit = vi.find_orbit(machine, start, cycles=1, method=METHOD)
    good = (orbit.result == vi.ORBIT_RESULTS.successful) & orbit.admissible
    hits = (orbit.y_max > machine.stop.gap).astype(int) if is_soft(machine) else orbit.impacts
    return jnp.stack(jax.tree.leaves(orbit.state)), hits, good


def _origin(point: vi.Point) -> np.ndarray:
    return np.array([float(x) for x in jax.tree.leaves(point.orbit.state)])


def _base(point: vi.Point) -> int:
    """Touches in a cycle of the motion that grazes."""
    return 0 if is_soft(point.orbit.machine) else int(np.asarray(point.orbit.impacts))


def _beside(point: vi.Point, name: str, offsets: Any, rows: np.ndarray) -> tuple[Any, Any]:
    """Machines at these offsets of the parameter and states from rows, one for each lane."""
    machine, tree = point.orbit.machine, jax.tree.structure(point.orbit.state)
    many = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(rows), *jnp.shape(x))), machine)
    many = changed(many, name, jnp.asarray(point.parameter + np.broadcast_to(offsets, len(rows))))
    return many, jax.tree.unflatten(tree, list(jnp.asarray(rows.T)))


def folds(point: vi.Point, name: str, lanes: Lanes, seed: int) -> bool:
    """Whether the motion of one cycle with a touch more is on the side without impacts. A candidate
    has to repeat when it is simulated, and to touch once more."""
    offset, state = _impacting(point, name, lanes, seed)
    many, starts = _beside(point, name, offset, state[None])
    miss, hits = map(np.asarray, _cycled(many, starts))
    distance = np.abs(state - _origin(point)).max()
    found = miss[0] < 0.01 * distance and hits[0] == _base(point) + 1
    return bool(found and np.sign(offset) == -lanes.side)


def _impacting(point: vi.Point, name: str, lanes: Lanes, seed: int) -> tuple[float, np.ndarray]:
    """A candidate, and its offset: by its own equations; for a soft stop by Newton's method from
    those of many random starts that touch once more and repeat best."""
    if not is_soft(point.orbit.machine):
        for distance in (1e-4, 1e-5, 1e-3):
            with contextlib.suppress(ValueError):
                orbit = point.switch(distance=distance)
                offset = float(number(orbit.machine, name)) - point.parameter
                return offset, np.array([float(x) for x in jax.tree.leaves(orbit.state)])
    rng, base = np.random.default_rng(seed), _base(point)
    offset = -lanes.side * lanes.offset[-1]
    way = rng.normal(size=(_STARTS, len(_origin(point))))
    reach = abs(offset) * np.exp(rng.uniform(np.log(_REACH[0]), np.log(_REACH[1]), (_STARTS, 1)))
    rows = _origin(point) + reach * way / np.linalg.norm(way, axis=1, keepdims=True)
    best = rows
    for _ in range(_ROUNDS):
        miss, hits = map(np.asarray, _cycled(*_beside(point, name, offset, rows)))
        order = np.argsort(np.where(hits == base + 1, miss, np.inf))[:_BEST]
        best, reach = rows[order], np.repeat(0.5 * reach[order], _STARTS // _BEST, axis=0)
        rows = np.repeat(best, _STARTS // _BEST, axis=0)
        rows = rows + reach * rng.normal(size=rows.shape)
        rows[:: _STARTS // _BEST] = best
    state, hits, good = map(np.asarray, _searched(*_beside(point, name, offset, best)))
    return offset, state[np.argmax(good & (hits == base + 1))]


def name_of(found: vi.Grazing) -> str:
    """The forecast's name in `vi.SCENARIOS`."""
    return repr(found.outcome).split(".")[-1]


def judged(
    point: vi.Point, name: str, found: vi.Grazing, seed: int
) -> tuple[float, float, Lanes, str]:
    """The range over which a forecast was checked (without doubtful small offsets), lanes in it,
    and the verdict."""
    looked = np.abs(found.forecast.offset)
    low, high = (looked.min(), looked.max()) if found.checked is None else found.checked
    low = min(max(low, 1e-9 * abs(point.parameter)), 0.03 * high)
    lanes = swept(point, name, low, high, seed)
    return low, high, lanes, verdict(point, name, lanes, seed)


def verdict(point: vi.Point, name: str, lanes: Lanes, seed: int) -> str:
    """The name in `vi.SCENARIOS` of what the lanes do.

    The rules are on the study's page. Distances are compared between the third of the lanes nearest
    to the grazing and the farthest third; of lanes that stay near, periods and touches count.
    """
    third = LANES // 3
    near, far = (np.median(lanes.distance[part]) for part in (slice(third), slice(-third, None)))
    ratio = np.median(lanes.offset[-third:]) / np.median(lanes.offset[:third])
    with np.errstate(invalid="ignore"):
        power = np.log(far / near) / np.log(ratio)
    if not np.isfinite([near, far]).all() or power < _GROWS:
        return "nonsmooth_fold" if folds(point, name, lanes, seed) else "jump"
    scaled = lanes.distance / np.sqrt(lanes.offset)
    stays = scaled <= _LEFT * np.median(scaled)
    period, touches = lanes.period[stays], lanes.touches[stays]
    aperiodic = (period == 0).mean()
    if (period == 1).mean() > _ALL:
        return "persistence"
    if aperiodic > _ALL:
        return "chaos"
    single = (period > 1) & (touches == 1)
    adding = single.sum() > 0.5 * (period > 0).sum() and _rises(lanes.offset[stays], period, single)
    if aperiodic < _FEW:
        return "period_adding" if adding else "periodic"
    return "period_adding_with_chaos" if adding else "windows_and_chaos"


def _rises(offset: np.ndarray, period: np.ndarray, single: np.ndarray) -> bool:
    """Whether the periods of motions with one touch rise towards the grazing, one of them next to
    another."""
    kinds = np.unique(period[single])
    places = [np.median(np.log(offset[single & (period == n)])) for n in kinds]
    return len(kinds) > 1 and bool((np.diff(places) < 0).all() and (np.diff(kinds) == 1).any())
