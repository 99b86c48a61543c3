"""Invariant curves of the section map, by collocation with Fourier modes.

A curve is given by N rows, N odd: the unknowns X of a motion from event to event (`Shooting`) at
the angles θ = j/N, in turns. The motion from θ goes on at θ + ρ, with the rotation number ρ. The
last flight of each row therefore leads to the first event of the curve at θ + ρ, which
trigonometric interpolation S gives:

    F(Xⱼ, (S X)ⱼ, p) = 0,   j = 1 … N.

Events are given, not detected, so the equations stay smooth beyond a grazing. Only clock and state
of the first event are interpolated; the other unknowns of a row are eliminated before the linear
system is solved. With a cyclic permutation in place of S the rows are the periods of a motion that
repeats after N of them.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .corrector import on_host
from .equations import Shooting

# Rows that a compiled program takes at once, a choice: fewer are filled up.
_LANES = 64

# The largest scaled component of the last correction: usually (the next would be its square), and
# if it is rounding; the most corrections; the largest one that is made at once. Choices.
_TOLERANCE, _ROUNDED, _MOST, _LONGEST = 1e-9, 1e-8, 14, 0.3

# The tail of a spectrum are the modes above this share of the highest: a choice.
_TAIL = 0.8


def in_lanes(program: Callable[..., Any], problem: Any, *rows: np.ndarray) -> Any:
    """Return the results of a compiled program for rows of arguments, some at a time."""
    count, parts = len(rows[0]), []
    for begin in range(0, count, _LANES):
        index = np.minimum(np.arange(begin, begin + _LANES), count - 1)
        parts.append(program(problem, *(np.asarray(a, float)[index] for a in rows)))
    return jax.tree.map(lambda *a: np.concatenate(a)[:count], *parts)


@on_host
def _linearize(problem: Shooting, x, following, p):
    size = x.shape[1]

    def along(x, following, p):
        def residual(z):
            motion = jnp.concatenate([z[:size], z[2 * size :]])
            return problem.motion_residual(motion, following=z[size : 2 * size])

        z = jnp.concatenate([x, following, p])
        pushed = lambda direction: jax.jvp(residual, (z,), (direction,))
        values, columns = jax.vmap(pushed)(jnp.eye(z.size, dtype=z.dtype))
        return values[0], columns.T

    return jax.vmap(along)(x, following, p)


@on_host
def _observe(problem: Shooting, x, following):
    return jax.vmap(problem.observe)(x, following)


@on_host
def _rates(problem: Shooting, x):
    def rate(x):
        clock, states = problem.parts(x)
        smooth = problem.flight(problem.at(x), problem.legs - 1).smooth
        return ravel_pytree(smooth.field(clock[0], problem.unravel(states[0])))[0]

    return jax.vmap(rate)(x)


@on_host
def _on_section(problem: Shooting, x):
    def state(x):
        leg, clock = problem.legs - 1, problem.period(x)
        if problem.events and problem.events[0].cycle == 0:
            leg, clock = 0, problem.parts(x)[0][0]
        return problem.state_at(x, leg, clock)

    return jax.vmap(state)(x)


def modes(number: int) -> np.ndarray:
    """Return the numbers of the Fourier modes of so many rows."""
    return np.fft.fftfreq(number, 1 / number)


def interpolated(rows: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return a curve's rows at other angles, in turns."""
    waves = np.exp(2j * np.pi * np.outer(angles, modes(len(rows))))
    return (waves @ (np.fft.fft(rows, axis=0) / len(rows))).real


def resampled(rows: np.ndarray, number: int) -> np.ndarray:
    return interpolated(rows, np.arange(number) / number)


def derivative(rows: np.ndarray) -> np.ndarray:
    """Return the derivative of a curve with respect to its angle, in turns."""
    waves = 2j * np.pi * modes(len(rows))[:, None]
    return np.fft.ifft(np.fft.fft(rows, axis=0) * waves, axis=0).real


def spectral_tail(rows: np.ndarray) -> float:
    """Return the largest high mode, relative to the largest mode; rows in scaled unknowns."""
    size, number = np.abs(np.fft.fft(rows, axis=0)).max(axis=1), np.abs(modes(len(rows)))
    high = number > _TAIL * (len(rows) // 2)
    largest = size[number > 0].max(initial=0.0)
    return float(size[high].max() / largest) if largest > 0 else 1.0


def _circulant(number: int, rotation: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix that interpolates rows at angles further by `rotation`, and its
    derivative."""
    waves = np.exp(2j * np.pi * modes(number) * rotation)
    index = np.subtract.outer(np.arange(number), np.arange(number)) % number
    columns = (np.fft.ifft(a).real for a in (waves, 2j * np.pi * modes(number) * waves))
    value, slope = (column[index] for column in columns)
    return value, slope


class Curve(NamedTuple):
    """Values of the unknowns."""

    x: np.ndarray
    """Unknowns of the motion at each node, (nodes, unknowns)."""
    rotation: float
    """Rotation number, in turns."""
    p: np.ndarray
    """Parameters, (parameters,)."""


class Condition(NamedTuple):
    """A linear equation between scaled unknowns: rows · u + rotation ρ + p · p = value."""

    rows: np.ndarray
    """Coefficients of the first event's clock and state at each node, (nodes, firsts)."""
    rotation: float
    p: np.ndarray
    value: float


class Solved(NamedTuple):
    curve: Curve
    size: float
    """The largest scaled component of the last correction."""
    iterations: int
    tangent: Condition
    """The change of the unknowns for a change of the last condition's value, its `value` 0."""


def cosine(one: Condition, other: Condition) -> float:
    """Return the product of two tangents; of a unit tangent with itself it is 1."""
    rows = np.mean(np.sum(resampled(one.rows, len(other.rows)) * other.rows, axis=1))
    return float(rows + one.rotation * other.rotation + one.p @ other.p)


def unit(tangent: Condition, sense: float = 1.0) -> Condition:
    size = sense / np.sqrt(cosine(tangent, tangent))
    return Condition(size * tangent.rows, size * tangent.rotation, size * tangent.p, 0.0)


@dataclasses.dataclass(frozen=True)
class Equations:
    """The equations of invariant curves; parameters of `problem` are unknowns."""

    problem: Shooting

    @cached_property
    def scale(self) -> np.ndarray:
        """The size of each unknown of a row, without parameters."""
        scale = self.problem.scale
        return scale[: len(scale) - len(self.problem.parameters)]

    @cached_property
    def widths(self) -> np.ndarray:
        return np.asarray(self.problem.widths, float).reshape(-1)

    @cached_property
    def first(self) -> np.ndarray:
        """Indices of clock and state of the first event in a row. The clock of an autonomous
        machine begins there, and its period is not interpolated."""
        clocks, states = len(self.problem.events), self.problem.states
        clock = [0] if clocks and not self.problem.autonomous else []
        return np.array([*clock, *range(clocks, clocks + states)])

    @property
    def begins_on_section(self) -> bool:
        """True if a row begins with the section, not with an event after it."""
        events = self.problem.events
        return not events or events[0].cycle == 0

    def scaled(self, x: np.ndarray) -> np.ndarray:
        """Return the interpolated part of each row in scaled unknowns, (nodes, firsts)."""
        return x[:, self.first] / self.scale[self.first]

    def tail(self, curve: Curve) -> float:
        return spectral_tail(self.scaled(curve.x))

    def following(self, curve: Curve) -> np.ndarray:
        count = len(curve.x)
        return interpolated(curve.x, np.arange(count) / count + curve.rotation)

    def observe(self, curve: Curve, angles: np.ndarray | None = None) -> Any:
        """Return `Observed` of the motion from each node, or from other angles, in arrays."""
        motion = self.motion(curve.p)
        if angles is None:
            return in_lanes(_observe, motion, curve.x, self.following(curve))
        x, after = (interpolated(curve.x, angles + turn) for turn in (0.0, curve.rotation))
        return in_lanes(_observe, motion, x, after)

    def cocycle(self, curve: Curve) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivative over a period and the direction along the curve, at each node. Both
        are those of the state just before the first event, at a given clock."""
        matrices, firsts = self.observe(curve).monodromy, derivative(curve.x)[:, self.first]
        if self.problem.autonomous:
            ends = np.einsum("jab,jb->ja", matrices, firsts)
            nodes = np.arange(len(ends)) / len(ends)
            return matrices, interpolated(ends, nodes - curve.rotation)
        if not self.problem.events:
            return matrices, firsts
        rates = in_lanes(_rates, self.motion(curve.p), curve.x)
        return matrices, firsts[:, 1:] - firsts[:, :1] * rates

    def on_section(self, curve: Curve, angles: np.ndarray) -> np.ndarray:
        """Return the states on the section at some angles, (angles, states)."""
        x = interpolated(curve.x, angles - (0.0 if self.begins_on_section else curve.rotation))
        return self._section_rows(curve.p, x) if self.problem.events else x

    def begin_of_cycle(self, cycle: Curve) -> np.ndarray:
        """Return the first state on the section of a periodic motion, a row for each period."""
        row = cycle.x[0 if self.begins_on_section else -1][None]
        return (self._section_rows(cycle.p, row) if self.problem.events else row)[0]

    def growth(self, cycle: Curve) -> float:
        """Return the greatest modulus of a multiplier of a periodic motion."""
        after = np.roll(cycle.x, -1, axis=0)
        found = in_lanes(_observe, self.motion(cycle.p), cycle.x, after).monodromy
        product = np.linalg.multi_dot(found[::-1]) if len(found) > 1 else found[0]
        return float(np.abs(np.linalg.eigvals(product)).max())

    def _section_rows(self, p: np.ndarray, x: np.ndarray) -> np.ndarray:
        state = in_lanes(_on_section, self.motion(p), x)
        return np.concatenate([a.reshape(len(x), -1) for a in jax.tree.leaves(state)], axis=1)

    def motion(self, p: np.ndarray) -> Shooting:
        """Return the equations of the motion alone at these values of the parameters."""
        blank = np.zeros(len(self.scale))
        return self.problem.motion_at(np.append(blank, p))[0] if len(p) else self.problem

    def solve(
        self, guess: Curve, conditions: Sequence[Condition], *, is_cycle: bool = False
    ) -> Solved | None:
        """Solve the equations and the conditions by Newton's method; `None` if it fails.

        With `is_cycle` the rows are the periods of a periodic motion, and ρ is not an unknown.
        """
        curve, before = guess, 1.0
        for count in range(1, _MOST + 1):
            move, tangent = self._correction(curve, conditions, is_cycle)
            if move is None or tangent is None:
                return None
            size = max(float(np.abs(a).max(initial=0.0)) for a in move)
            share = min(1.0, _LONGEST / size) if size > 0 else 1.0
            curve = Curve(
                curve.x + share * move[0] * self.scale, curve.rotation + share * float(move[1]),
                curve.p + share * move[2] * self.widths,
            )  # fmt: skip
            if size <= _TOLERANCE or (before <= _ROUNDED and size >= before):
                return Solved(curve, size, count, tangent)
            before = size
        return None

    def _correction(
        self, curve: Curve, conditions: Sequence[Condition], is_cycle: bool
    ) -> tuple[Any, Condition | None]:
        """Return the scaled change of x, rotation and p, and the tangent (see `Solved`)."""
        count, firsts, width = len(curve.x), self.first, len(self.scale)
        shift, slope = _circulant(count, curve.rotation)
        if is_cycle:
            shift, slope = np.roll(np.eye(count), 1, axis=1), None
        following = shift @ curve.x
        p = np.tile(curve.p, (count, 1))
        residual, columns = in_lanes(_linearize, self.problem, curve.x, following, p)
        if not (np.isfinite(residual).all() and np.isfinite(columns).all()):
            return None, None
        columns = columns * np.concatenate([self.scale, self.scale, self.widths])
        rows = np.abs(columns).max(axis=2)
        rows = np.where(rows > 0, rows, 1.0)
        residual, columns = residual / rows, columns / rows[..., None]
        own, next_part = columns[..., :width], columns[..., width : 2 * width][..., firsts]
        by_p = columns[..., 2 * width :]
        rest = np.setdiff1d(np.arange(width), firsts)

        # Combinations of the equations without the unknowns that are not interpolated.
        basis, triangle = np.linalg.qr(own[..., rest], mode="complete")
        reduce = np.swapaxes(basis[..., len(rest) :], 1, 2)
        here, after = reduce @ own[..., firsts], reduce @ next_part
        k = len(firsts)
        matrix = np.einsum("jab,ji->jaib", after, shift)
        matrix[np.arange(count), :, np.arange(count)] += here
        blocks = [matrix.reshape(count * k, count * k)]
        by_rotation = np.zeros((count, width, 0))
        if slope is not None:
            turned = slope @ self.scaled(curve.x)
            by_rotation = np.einsum("jab,jb->ja", next_part, turned)[..., None]
        others = np.concatenate([by_rotation, by_p], axis=2)
        blocks.append((reduce @ others).reshape(count * k, -1))
        left = np.hstack(blocks)
        given = [self._row(condition, is_cycle) for condition in conditions]
        left = np.vstack([left, *given]) if given else left
        turn = [] if is_cycle else [curve.rotation]
        u = np.concatenate([self.scaled(curve.x).ravel(), turn, curve.p / self.widths])
        misses = [row @ u - c.value for row, c in zip(given, conditions, strict=True)]
        right = np.concatenate([(reduce @ residual[..., None]).ravel(), misses])
        direction = np.zeros_like(right)
        direction[-1] = 1.0
        try:
            move, along = np.linalg.solve(left, np.stack([-right, direction], axis=1)).T
        except np.linalg.LinAlgError:
            return None, None
        if not np.isfinite(move).all():
            return None, None
        x = np.zeros((count, width))
        x[:, firsts] = move[: count * k].reshape(count, k)
        if len(rest):
            remaining = residual + np.einsum("jab,jb->ja", own[..., firsts], x[:, firsts])
            remaining += np.einsum("jab,jb->ja", next_part, shift @ x[:, firsts])
            remaining += others @ move[count * k :]
            lower = np.swapaxes(basis[..., : len(rest)], 1, 2) @ remaining[..., None]
            x[:, rest] = -np.linalg.solve(triangle[:, : len(rest)], lower)[..., 0]
        ahead = move[count * k :]
        turn = 0.0 if is_cycle else ahead[0]
        tangent = Condition(
            along[: count * k].reshape(count, k), 0.0 if is_cycle else float(along[count * k]),
            along[len(along) - len(curve.p) :], 0.0,
        )  # fmt: skip
        return (x, turn, ahead[len(ahead) - len(curve.p) :]), tangent

    def _row(self, condition: Condition, is_cycle: bool) -> np.ndarray:
        turn = [] if is_cycle else [condition.rotation]
        return np.concatenate([condition.rows.ravel(), turn, condition.p])

    def phase(self, curve: Curve) -> Condition:
        """Return the condition that a curve does not turn in itself against this one."""
        along = derivative(self.scaled(curve.x))
        along = along / np.linalg.norm(along)
        value = float(np.sum(along * self.scaled(curve.x)))
        return Condition(along, 0.0, np.zeros(len(self.widths)), value)

    def at_parameter(self, curve: Curve, value: float) -> Condition:
        """Return the condition that the last parameter has a value."""
        p = np.zeros(len(self.widths))
        p[-1] = 1.0
        return Condition(np.zeros((len(curve.x), len(self.first))), 0.0, p, value / self.widths[-1])

    def solve_near(self, guess: Curve, value: float | None = None) -> Solved | None:
        """Solve at the guess's parameters, or at another value of the last one."""
        conditions = [self.phase(guess)]
        if len(guess.p):
            value = float(guess.p[-1]) if value is None else value
            guess = guess._replace(p=np.append(guess.p[:-1], value))
            conditions.append(self.at_parameter(guess, value))
        return self.solve(guess, conditions)

    def across(self, curve: Curve, tangent: Condition, length: float = 0.0) -> Condition:
        """Return the condition that a curve lies in the plane across a tangent, at a distance."""
        nodes, turn = len(curve.x), tangent.rotation
        rows = resampled(tangent.rows, nodes) / nodes
        value = np.sum(rows * self.scaled(curve.x)) + turn * curve.rotation
        value += tangent.p @ (curve.p / self.widths) + length
        return Condition(rows, turn, tangent.p, float(value))

    def refined(self, solved: Solved, tail: float, most: int) -> Solved | None:
        """Double the nodes until the tail is small, or more than `most` were needed; `None` if the
        equations are not solved with more nodes."""
        while self.tail(solved.curve) > tail and 2 * len(solved.curve.x) - 1 <= most:
            curve = solved.curve
            finer = curve._replace(x=resampled(curve.x, 2 * len(curve.x) - 1))
            held = [self.across(finer, unit(solved.tangent))] if len(curve.p) else []
            found = self.solve(finer, [self.phase(finer), *held])
            if found is None:
                return None
            solved = found
        return solved

    def rotating_mode(self, point: Curve) -> tuple[float, np.ndarray]:
        """Return rotation number and complex mode of the infinitesimal curves around a periodic
        motion, one row, in scaled unknowns; those of its complex multiplier closest to modulus 1.
        """
        from scipy.linalg import eig  # slow to load

        width, firsts = len(self.scale), self.first
        _, columns = in_lanes(_linearize, self.problem, point.x, point.x, point.p[None])
        columns = columns[0] * np.concatenate([self.scale, self.scale, self.widths])
        columns = columns / np.abs(columns).max(axis=1, keepdims=True)
        own, after = columns[:, :width], np.zeros((width, width))
        after[:, firsts] = columns[:, width : 2 * width][:, firsts]
        pairs: Any = eig(own, -after)
        values, vectors = pairs[:2]
        finite = (
            np.isfinite(values) & (np.abs(values) < 1 / _ROUNDED) & (np.imag(values) > _ROUNDED)
        )
        distance = np.where(finite, np.abs(np.abs(values) - 1), np.inf)
        i = int(np.argmin(distance))
        mode = vectors[:, i]
        return float(np.angle(values[i]) / (2 * np.pi)), mode / np.linalg.norm(mode[firsts])
