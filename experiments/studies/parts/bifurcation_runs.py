"""The simulations of `bifurcation_diagram.py`: settled motions, and how fast neighbours part."""

import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from tools.ideal import machine
from tools.study import QUICK, say
from tools.timing import Clock

K = 0.8
PARTS = {
    "wide": (0.94, 1.0), "left": (0.9540, 0.9547), "middle": (0.9920, 0.9934),
    "right": (0.9936, 0.9940),
}  # fmt: skip
"""Ranges of ζ: the whole, and three stretches of it that are magnified."""
STARTS = np.array([[-2.0, 0.0], [-1.948, 1.207]])  # (Y, V) at φ = π: near a 2π, near a 4π motion
CHUNK, SEEN = 100, 256
CHUNKS, ROUNDS, VALUES = (10, 50, (64, 32, 32, 32)) if QUICK else (200, 400, (480, 160, 160, 160))
SMALL, LARGE = 1e-9, 1e-2


def at_half_turn(zeta: Any) -> vi.Scene:
    """The undamped machine with its section at φ = π, because impacts lie near φ = 0."""
    return machine(zeta, K, 0.0).at_section(np.pi)


def _lane(zeta: Any, start: Any, chunks: Any, rounds: Any) -> tuple[Any, ...]:
    """One lane settles, is observed, and is then run beside two neighbours 1e-9 away.

    The distance of one is set back to 1e-9 every two cycles: its mean growth (without the first
    quarter, in which it turns into the direction that grows most) is the largest Lyapunov exponent.
    The other is left alone, and the cycles are counted until it is 0.01 away.
    """
    there = at_half_turn(zeta)

    def go(state, cycles):
        return vi.simulate(there, state, cycles, method=vi.ExactFlight(), record="sections")

    def last(run):
        return jax.tree.map(lambda x: x[-1], run.sections)

    def apart(a, b):
        return jnp.hypot(b.Y - a.Y, b.V - a.V)

    # In chunks: a run keeps all its sections, and only the last few are wanted.
    state = there.start(Y=start[0], V=start[1])
    state = jax.lax.fori_loop(0, chunks, lambda _, state: last(go(state, CHUNK)), state)
    seen = vi.simulate(there, state, SEEN, method=vi.ExactFlight(), impact_log=3)
    state, log = last(seen), seen.impact_log
    assert log is not None
    beside = there.start(Y=state.Y + SMALL, V=state.V)

    def two_cycles(i, carried):
        here, near, free, total, escaped = carried
        here, near, free = (last(go(x, 2)) for x in (here, near, free))
        far = apart(here, near)
        near = jax.tree.map(lambda x, y: x + (y - x) * SMALL / far, here, near)
        total += jnp.where(4 * i >= rounds, jnp.log(far / SMALL), 0.0)
        escaped = jnp.where((escaped < 0) & (apart(here, free) > LARGE), 2.0 * (i + 1), escaped)
        return here, near, free, total, escaped

    carried = (state, beside, beside, jnp.zeros(()), -jnp.ones(()))
    *_, total, escaped = jax.lax.fori_loop(0, rounds, two_cycles, carried)
    Y, V = seen.sections.Y[1:], seen.sections.V[1:]
    return Y, V, log.speed, seen.impacts, total / (1.5 * rounds), escaped


@vi.jit
def _lanes(zeta, start, chunks, rounds):
    return jax.lax.map(lambda x: _lane(x[0], x[1], chunks, rounds), (zeta, start), batch_size=256)


class Settled(NamedTuple):
    """What each lane settled on; the lanes are both starts, one after the other, at each ζ."""

    zeta: np.ndarray
    start: np.ndarray
    """0 or 1: the number of the start."""
    part: np.ndarray
    """The stretch, by its name in `PARTS`."""
    Y: np.ndarray
    V: np.ndarray
    """Sections, `(lanes, SEEN)`."""
    speed: np.ndarray
    """Of the impacts, `(lanes, SEEN, 3)`."""
    impacts: np.ndarray
    """In each cycle, `(lanes, SEEN)`."""
    exponent: np.ndarray
    """Growth of a neighbour's distance per cycle."""
    escaped: np.ndarray
    """Cycles until the other neighbour is 0.01 away; -1 if it never is."""
    clock: Clock

    def repeats(self, period: int) -> np.ndarray:
        """Whether a lane's sections repeat after a number of cycles."""
        return np.abs(self.Y[:, period:] - self.Y[:, :-period]).max(axis=1) < 1e-6

    def bands(self, count: int) -> np.ndarray:
        """Whether a motion visits this many regions of the section in turn, apart in Y or in V."""
        found = np.ones(len(self.Y), bool)
        for i, j in itertools.combinations(range(count), 2):
            separate = np.zeros(len(self.Y), bool)
            for a in (self.Y, self.V):
                one, other = a[:, i::count], a[:, j::count]
                separate |= one.max(axis=1) < other.min(axis=1)
                separate |= other.max(axis=1) < one.min(axis=1)
            found &= separate
        return found

    def orbit(self, zeta: float, start: int, cycles: int) -> vi.Orbit:
        """The orbit beside the section state on which the start's lane nearest to ζ ended."""
        mine = np.flatnonzero(self.start == start)
        i = mine[np.argmin(np.abs(self.zeta[mine] - zeta))]
        there = at_half_turn(self.zeta[i])
        guess = there.start(Y=float(self.Y[i, -1]), V=float(self.V[i, -1]))
        return vi.find_orbit(there, guess, cycles, throw=True)


def settled() -> Settled:
    """All lanes, in one compiled call."""
    grids = [np.linspace(*r, n) for r, n in zip(PARTS.values(), VALUES, strict=True)]
    zetas = np.concatenate(grids)
    number = np.repeat([0, 1], len(zetas))
    lanes = np.tile(zetas, 2), STARTS[number]
    arguments = (*map(jnp.asarray, lanes), CHUNKS, ROUNDS)
    compiled = _lanes.lower(*arguments).compile()
    say("compiled the brute-force program")
    with Clock() as clock:
        Y, V, speed, impacts, exponent, escaped = map(np.asarray, compiled(*arguments))
    say(f"{len(number)} lanes of {CHUNKS * CHUNK} cycles and more: {clock.wall:.1f} s")
    part = np.tile(np.repeat(list(PARTS), VALUES), 2)
    return Settled(
        lanes[0], number, part, Y, V, speed, impacts, exponent, escaped, clock
    )  # fmt: skip
