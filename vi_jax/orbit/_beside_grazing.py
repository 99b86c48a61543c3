"""What a machine does beside a grazing, where the local map forecasts it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from .._programs import compiled
from ..flow import simulate
from ..machine import in_rows, stops_of, with_leaf
from ._forecast import (
    LOOKED,
    Settled,
    impacts_in,
    kick_sizes,
    local_depths,
    periods_in,
    settled,
    settling,
)
from ._local_map import Graze
from ._shooting import Shooting

# What differs by less, as a share of the motion, is the same but for rounding: a choice.
_ROUNDING = 1e-11

# Far away a motion is periodic if it repeats within 1e-6 of how far it is: a choice.
_FAR = 1e-3

# A motion on the section farther off than so many kicks of the greatest depth could add up to has
# left: a choice.
_KICKS = 64


class Simulated(NamedTuple):
    """What the machine settles on, lane by lane."""

    period: np.ndarray
    """As `Settled.period`; -1 also for a lane that left the neighbourhood or failed."""
    impacts: np.ndarray
    """At the touches, as `Settled.impacts`; NaN where what is touched is no rigid stop."""
    places: np.ndarray
    """On the section, less the smooth motion; (lanes, LOOKED, states)."""
    far: np.ndarray
    """As `period`, of lanes that left; 0 for others."""
    hits: np.ndarray
    """All impacts in `far` periods of the motion that grazes; in one of them if `far` is 0."""


@compiled
def _lanes(problem, method, name: str, values, states, cycles: int, settle):
    """Sections and impacts of the last cycles, (lanes, cycles)."""

    def one(value, u):
        machine = with_leaf(problem.machine, name, value)
        run = simulate(
            machine, problem.unravel(u), cycles, settle=settle, method=method, record="sections"
        )
        rows = in_rows(run.sections)
        return rows[1:], run.impacts, run.successful

    return jax.vmap(one)(values, states)


def simulated(graze: Graze, offsets: np.ndarray) -> Simulated:
    """The machine at each offset of the parameter, from the smooth motion on."""
    problem, section, local = graze.problem, graze.section, graze.map
    value = float(graze.x[-1])
    smooth = section.state + np.outer(offsets, section.slope)
    found = _lanes(
        problem, problem.method, problem.parameters[0], jnp.asarray(value + offsets),
        jnp.asarray(smooth), problem.cycles * LOOKED, settling(local) * problem.cycles,
    )  # fmt: skip
    rows, impacts, good = (np.asarray(a) for a in found)
    last = rows[:, problem.cycles - 1 :: problem.cycles] - smooth[:, None]
    hits = impacts.reshape(len(rows), LOOKED, problem.cycles).sum(axis=2) - len(problem.impacts)
    size = kick_sizes(local, offsets)
    u, added = local.kicks.T, np.zeros(len(section.state))
    for _ in range(_KICKS):
        added += np.abs(section.matrix @ u).max(axis=1)
        u = local.matrix @ u
    unit = np.abs(local.kicks).max()
    reach = np.abs(section.matrix @ local.kicks.T).max() / unit * size
    rounding = _ROUNDING * np.abs(smooth).max()
    period = periods_in(last, hits, reach + rounding)
    deepest = local_depths(local, offsets) ** (2 * local.orders.min())
    away = np.abs(last).max(axis=(1, 2)) > added.max() * deepest + rounding
    good = good & np.isfinite(last).all(axis=(1, 2))
    span = np.abs(last).max(axis=(1, 2), initial=0.0, where=np.isfinite(last))
    far = np.where(good & away, periods_in(last, hits, _FAR * span), 0)
    period = np.where(good & ~away, period, -1)
    rigid = all(touch.number < len(stops_of(problem.machine)) for touch in graze.touches)
    counted = impacts_in(hits, period) if rigid else np.full(len(period), np.nan)
    whole = impacts_in(hits, np.where(far > 0, far, 1)) + np.maximum(far, 1) * len(problem.impacts)
    return Simulated(period, counted, last, far, whole)


def alike(forecast: Settled, machine: Simulated) -> np.ndarray:
    """Whether forecast and machine settle on the same period, with the same impacts in it."""
    counted = np.isnan(machine.impacts) | (forecast.impacts == machine.impacts)
    return (forecast.period == machine.period) & (counted | (forecast.period <= 0))


# Decades below the greatest depth that are looked at: a choice.
DECADES = 4

# The machine is asked at one value of so many, and where nothing is touched at one of these.
ASKED, _SPARSE = 6, 4

# The machine agrees over a stretch of the parameter if it does in so much of each half decade: at
# the edges of windows the first order that a local map is does not decide.
_AGREES = 0.75


class Motions(NamedTuple):
    """What is settled on at several values of the parameter, as the local map or the machine has
    it."""

    offset: Float[np.ndarray, " values"]
    """The parameter, less its value at the grazing."""
    period: Int[np.ndarray, " values"]
    """In periods of the motion that grazes; 0 where there is none, -1 where what follows is far
    away."""
    impacts: Float[np.ndarray, " values"]
    """Impacts at the touch in a period; on average over one where there is none."""
    position: Float[np.ndarray, "values looked"]
    """Of the first coordinate on the section, less that of the smooth motion."""


@compiled
def _position_of(problem: Shooting, states):
    """The first coordinate in each state."""
    flat = states.reshape(-1, problem.states)
    return jax.vmap(lambda u: problem.machine.position(problem.unravel(u)))(flat).reshape(
        states.shape[:-1]
    )


def positions(graze: Graze, offsets: np.ndarray, beside: np.ndarray) -> np.ndarray:
    """The first coordinate on the section, less that of the smooth motion.

    **Arguments:** the parameter's offsets; states, less the smooth motion's, (values, looked, n).
    """
    smooth = graze.section.state + np.outer(offsets, graze.section.slope)
    there = _position_of(graze.problem, jnp.asarray(smooth[:, None] + beside))
    return np.asarray(there) - np.asarray(_position_of(graze.problem, jnp.asarray(smooth)))[:, None]


def beside_grazing(
    graze: Graze, offsets: np.ndarray, found: Settled
) -> tuple[Motions, tuple[np.ndarray, np.ndarray], tuple[int, int] | None]:
    """What the machine does at the same values; whether that is alike there, and (at some of them)
    on the other side; and period and impacts of what it settles on if it goes far away.

    **Arguments:** the parameter's offsets; what the local map settles on there.
    """
    sparse, n = offsets[::_SPARSE], len(offsets)
    machine = simulated(graze, np.concatenate([offsets, -sparse]))
    here, there = (Simulated(*(part[which] for part in machine))
                   for which in (slice(n), slice(n, None)))  # fmt: skip
    same = alike(found, here), alike(settled(graze.map, -sparse), there)
    beyond = Motions(offsets, here.period, here.impacts, positions(graze, offsets, here.places))
    return beyond, same, _far(here, graze.problem.cycles)


def _far(seen: Simulated, cycles: int) -> tuple[int, int] | None:
    """Period and impacts of what most of the lanes that left settle on."""
    left = seen.period < 0
    if left.mean() < 0.5:
        return None
    both = zip(seen.far[left], seen.hits[left], strict=True)
    kinds = [(int(p) * cycles, round(float(n)) if p else 0) for p, n in both]
    return max(set(kinds), key=kinds.count)


def stretch(
    size: np.ndarray, here: np.ndarray, there: np.ndarray
) -> tuple[tuple[float, float] | None, float]:
    """The longest stretch, in half decades, in which forecast and machine agree, and the share of
    values there that do.

    **Arguments:** sizes of the offsets, rising; where both agree, and on the other side.
    """
    parts = 2 * DECADES
    half = np.minimum((np.arange(len(size)) * parts) // (len(size) - 1), parts - 1)
    good = [
        here[half == i].mean() >= _AGREES and there[half[::_SPARSE] == i].all()
        for i in range(parts)
    ]
    best, begin = (0, 0), None
    for i, fits in enumerate([*good, False]):
        if fits and begin is None:
            begin = i
        elif not fits and begin is not None:
            best, begin = max(best, (begin, i), key=lambda b: b[1] - b[0]), None
    inside = (half >= best[0]) & (half < best[1])
    if not inside.any():
        return None, np.nan
    share = np.concatenate([here[inside], there[inside[::_SPARSE]]]).mean()
    return (float(size[inside][0]), float(size[inside][-1])), float(share)
