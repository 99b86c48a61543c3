"""Invariant curves of the section map, by collocation with Fourier modes.

A curve is given by N rows, N odd: the unknowns X of a motion from event to event (`Shooting`) at
the angles θ = j/N, in turns. The motion from θ goes on at θ + ρ, with the rotation number ρ. The
last flight of each row therefore leads to the first event of the curve at θ + ρ, which
trigonometric interpolation S gives:

    F(Xⱼ, (S X)ⱼ, p) = 0,   j = 1 … N.

Events are given, not detected, so the equations stay smooth beyond a grazing. With a cyclic
permutation in place of S the rows are the periods of a motion that repeats after N of them.
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
    """Return the rate of the state just before the first event."""

    def rate(x):
        clock, states = problem.parts(x)
        smooth = problem.flight(problem.at(x), problem.legs - 1).smooth
        return ravel_pytree(smooth.field(clock[0], problem.unravel(states[0])))[0]

    return jax.vmap(rate)(x)


@on_host
def _on_section(problem: Shooting, x):
    """Return the state on the section with which a motion begins, else that in which it ends."""

    def state(x):
        leg, clock = problem.legs - 1, problem.period(x)
        if begins_on_section(problem):
            leg, clock = 0, problem.parts(x)[0][0]
        return ravel_pytree(problem.state_at(x, leg, clock))[0]

    return jax.vmap(state)(x)


def begins_on_section(problem: Shooting) -> bool:
    return bool(problem.events) and problem.events[0].cycle == 0


def modes(number: int) -> np.ndarray:
    """Return the numbers of the Fourier modes of so many rows."""
    return np.fft.fftfreq(number, 1 / number)


def interpolated(rows: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return a curve's rows at other angles, in turns."""
    waves = np.exp(2j * np.pi * np.outer(angles, modes(len(rows))))
    return (waves @ (np.fft.fft(rows, axis=0) / len(rows))).real


def derivative(rows: np.ndarray) -> np.ndarray:
    """Return the derivative of a curve with respect to its angle, in turns."""
    waves = 2j * np.pi * modes(len(rows))[:, None]
    return np.fft.ifft(np.fft.fft(rows, axis=0) * waves, axis=0).real


def spectral_tail(rows: np.ndarray) -> float:
    """Return the largest high mode of a curve, relative to its largest mode."""
    size, number = np.abs(np.fft.fft(rows, axis=0)).max(axis=1), np.abs(modes(len(rows)))
    largest = size[number > 0].max(initial=0.0)
    high = size[number > _TAIL * (len(rows) // 2)].max()
    return float(high / largest) if largest > 0 else 1.0


def _circulant(number: int, rotation: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix that interpolates rows at angles further by `rotation`, and its
    derivative."""
    waves = np.exp(2j * np.pi * modes(number) * rotation)
    index = np.subtract.outer(np.arange(number), np.arange(number)) % number
    columns = (np.fft.ifft(a).real for a in (waves, 2j * np.pi * modes(number) * waves))
    value, slope = (column[index] for column in columns)
    return value, slope


class Curve(NamedTuple):
    """Values of the unknowns, or their change along a family."""

    x: np.ndarray
    """Unknowns of the motion at each node, (nodes, unknowns)."""
    rotation: float
    """Rotation number, in turns."""
    p: np.ndarray
    """Parameters, (parameters,)."""

    def with_nodes(self, number: int) -> "Curve":
        return self._replace(x=interpolated(self.x, np.arange(number) / number))

    def towards(self, other: "Curve", share: float) -> "Curve":
        """Return the curve at a share of the way to another one."""
        nodes = max(len(self.x), len(other.x))
        parts = zip(self.with_nodes(nodes), other.with_nodes(nodes), strict=True)
        return Curve(*((1 - share) * a + share * b for a, b in parts))  # pyright: ignore


Condition = tuple[np.ndarray, float]
"""A linear equation between all unknowns in a row (see `Equations.pack`): coefficients, value."""


class Solved(NamedTuple):
    curve: Curve
    size: float
    """The largest scaled component of the last correction."""
    iterations: int
    tangent: Curve
    """The change of the unknowns for a change of the last condition's value."""


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

    def pack(self, curve: Curve) -> np.ndarray:
        """Return scaled unknowns in a row. Its norm is the mean over the nodes."""
        x = curve.x / self.scale / np.sqrt(len(curve.x))
        return np.concatenate([x.ravel(), [curve.rotation], curve.p / self.widths])

    def unpack(self, row: np.ndarray, nodes: int) -> Curve:
        end = nodes * len(self.scale)
        x = row[:end].reshape(nodes, -1) * self.scale * np.sqrt(nodes)
        return Curve(x, float(row[end]), row[end + 1 :] * self.widths)

    def tail(self, curve: Curve) -> float:
        return spectral_tail(curve.x / self.scale)

    def motion(self, p: np.ndarray) -> Shooting:
        """Return the equations of the motion alone at these values of the parameters."""
        blank = np.zeros(len(self.scale))
        return self.problem.motion_at(np.append(blank, p))[0] if len(p) else self.problem

    def observe(self, curve: Curve, angles: np.ndarray | None = None) -> Any:
        """Return `Observed` of the motion from each node, or from other angles, in arrays."""
        angles = np.arange(len(curve.x)) / len(curve.x) if angles is None else angles
        x, after = (interpolated(curve.x, angles + turn) for turn in (0.0, curve.rotation))
        return in_lanes(_observe, self.motion(curve.p), x, after)

    def cocycle(self, curve: Curve) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivative over a period and the direction along the curve, at each node. Both
        are those of the state just before the first event, at a given clock."""
        problem, slopes = self.problem, derivative(curve.x)
        begin, matrices = len(problem.events), self.observe(curve).monodromy
        along = slopes[:, begin : begin + problem.states]
        if problem.autonomous:
            ends = np.einsum("jab,jb->ja", matrices, along)
            along = interpolated(ends, np.arange(len(ends)) / len(ends) - curve.rotation)
        elif problem.events:
            along = along - slopes[:, :1] * in_lanes(_rates, self.motion(curve.p), curve.x)
        return matrices, along

    def on_section(self, curve: Curve, angles: np.ndarray) -> np.ndarray:
        """Return the states on the section at some angles, (angles, states)."""
        back = 0.0 if begins_on_section(self.problem) else curve.rotation
        return in_lanes(_on_section, self.motion(curve.p), interpolated(curve.x, angles - back))

    def growth(self, cycle: Curve) -> float:
        """Return the greatest modulus of a multiplier of a periodic motion, a row for a period."""
        after = np.roll(cycle.x, -1, axis=0)
        found = in_lanes(_observe, self.motion(cycle.p), cycle.x, after).monodromy
        product = np.linalg.multi_dot([np.eye(found.shape[-1]), *found[::-1]])
        return float(np.abs(np.linalg.eigvals(product)).max())

    def solve(
        self, guess: Curve, conditions: Sequence[Condition], *, is_cycle: bool = False
    ) -> Solved | None:
        """Solve the equations and the conditions by Newton's method; `None` if it fails.

        With `is_cycle` the rows are the periods of a periodic motion, and ρ has its given value.
        """
        curve, before = guess, 1.0
        for count in range(1, _MOST + 1):
            moves = self._newton(curve, conditions, is_cycle)
            if moves is None:
                return None
            move, tangent = (self.unpack(row, len(curve.x)) for row in moves)
            size = max(np.abs(move.x / self.scale).max(), *np.abs(moves[0][move.x.size :]))
            share = min(1.0, _LONGEST / size) if size > 0 else 1.0
            curve = Curve(*(a + share * b for a, b in zip(curve, move, strict=True)))  # pyright: ignore
            if size <= _TOLERANCE or (before <= _ROUNDED and size >= before):
                return Solved(curve, float(size), count, tangent)
            before = size
        return None

    def _newton(
        self, curve: Curve, conditions: Sequence[Condition], is_cycle: bool
    ) -> np.ndarray | None:
        """Return Newton's correction and the tangent (see `Solved`), as rows of unknowns."""
        (count, width), row = curve.x.shape, self.pack(curve)
        shift, slope = _circulant(count, curve.rotation)
        if is_cycle:
            shift, slope = np.roll(np.eye(count), 1, axis=1), 0 * slope
            conditions = [self._value_of(curve, count * width, curve.rotation), *conditions]
        arguments = curve.x, shift @ curve.x, np.tile(curve.p, (count, 1))
        residual, columns = in_lanes(_linearize, self.problem, *arguments)
        unit = self.scale * np.sqrt(count)
        columns = columns * np.concatenate([unit, unit, self.widths])
        rows = np.abs(columns).max(axis=2)
        rows = np.where(rows > 0, rows, 1.0)
        columns, residual = columns / rows[..., None], residual / rows
        own, after, by_p = np.split(columns, [width, 2 * width], axis=2)
        matrix = np.einsum("jab,ji->jaib", after, shift)
        matrix[np.arange(count), :, np.arange(count)] += own
        by_rotation = np.einsum("jab,jb->ja", after, slope @ (curve.x / unit))
        total = count * width
        blocks = matrix.reshape(total, total), by_rotation.reshape(total, 1)
        left = np.hstack([*blocks, by_p.reshape(total, len(curve.p))])
        left = np.vstack([left, *(coefficients for coefficients, _ in conditions)])
        misses = [coefficients @ row - value for coefficients, value in conditions]
        right = np.append(residual.ravel(), misses)
        if not (np.isfinite(left).all() and np.isfinite(right).all()):
            return None
        try:
            moves = np.linalg.solve(left, np.stack([-right, np.eye(len(right))[-1]], axis=1)).T
        except np.linalg.LinAlgError:
            return None
        return moves if np.isfinite(moves).all() else None

    def _value_of(self, curve: Curve, index: int, value: float) -> Condition:
        """Return the condition that an unknown of the row has a value."""
        coefficients = np.zeros(curve.x.size + 1 + len(curve.p))
        coefficients[index] = 1.0
        return coefficients, value

    def along(self, rows: np.ndarray, x: np.ndarray) -> Condition:
        """Return the condition that a curve does not move along `rows` against `x`."""
        none = np.zeros(len(self.widths))
        direction = self.unit(Curve(rows, 0.0, none))
        return direction, float(direction @ self.pack(Curve(x, 0.0, none)))

    def phase(self, curve: Curve) -> Condition:
        """Return the condition that a curve does not turn in itself against this one."""
        return self.along(derivative(curve.x), curve.x)

    def across(self, curve: Curve, tangent: Curve, length: float = 0.0) -> Condition:
        """Return the condition that a curve lies in the plane across a tangent, at a distance."""
        direction = self.unit(tangent.with_nodes(len(curve.x)))
        return direction, float(direction @ self.pack(curve)) + length

    def unit(self, tangent: Curve) -> np.ndarray:
        row = self.pack(tangent)
        return row / np.linalg.norm(row)

    def solve_near(self, guess: Curve, value: float | None = None) -> Solved | None:
        """Solve at the guess's parameters, or at another value of the last one."""
        conditions = [self.phase(guess)]
        if len(guess.p):
            value = float(guess.p[-1]) if value is None else value
            guess = guess._replace(p=np.append(guess.p[:-1], value))
            conditions.append(self._value_of(guess, -1, value / self.widths[-1]))
        return self.solve(guess, conditions)

    def refined(self, solved: Solved, tail: float, most: int) -> Solved | None:
        """Double the nodes until the tail is small, or more than `most` were needed; `None` if the
        equations are not solved with more nodes."""
        found: Solved | None = solved
        while found and self.tail(found.curve) > tail and 2 * len(found.curve.x) - 1 <= most:
            finer = found.curve.with_nodes(2 * len(found.curve.x) - 1)
            held = [self.across(finer, found.tangent)] if len(finer.p) else []
            found = self.solve(finer, [self.phase(finer), *held])
        return found

    def rotating_mode(self, point: Curve) -> tuple[float, np.ndarray]:
        """Return rotation number and complex mode of the infinitesimal curves around a periodic
        motion, one row, in scaled unknowns; those of its complex multiplier closest to modulus 1.
        """
        from scipy.linalg import eig  # slow to load

        width, units = len(self.scale), [self.scale, self.scale, self.widths]
        columns = in_lanes(_linearize, self.problem, point.x, point.x, point.p[None])[1][0]
        columns = columns * np.concatenate(units)
        columns = columns / np.abs(columns).max(axis=1, keepdims=True)
        pairs: Any = eig(columns[:, :width], -columns[:, width : 2 * width])
        values = pairs[0]
        turns = np.isfinite(values) & (np.imag(values) > _ROUNDED)
        distance = np.where(turns, np.abs(np.abs(values) - 1), np.inf)
        i = int(np.argmin(distance))
        return float(np.angle(values[i]) / (2 * np.pi)), pairs[1][:, i]
