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
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._types import State
from ..machine import own_modes, with_modes
from .corrector import host_program, scaled_jacobian
from .equations import Shooting
from .tolerances import CORRECTED, ROUGHLY, ROUNDING

# Rows that a compiled program takes at once, a choice: fewer are filled up.
_LANES = 64

# The most corrections, and the largest scaled component of one that is made at once. Choices.
_MOST, _LONGEST = 14, 0.3

# The tail of a spectrum are the modes above this share of the highest: a choice.
_TAIL = 0.8


def in_lanes(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function of something shared and of rows, each an array of the host, for all rows
    of some arrays; so many at a time."""
    program = host_program(lambda shared, *rows: jax.vmap(partial(function, shared))(*rows))

    def call(shared: Any, *rows: np.ndarray) -> Any:
        count, parts = len(rows[0]), []
        for begin in range(0, count, _LANES):
            index = np.minimum(np.arange(begin, begin + _LANES), count - 1)
            parts.append(program(shared, *(np.asarray(a, float)[index] for a in rows)))
        return jax.tree.map(lambda *a: np.concatenate(a)[:count], *parts)

    return call


@in_lanes
def _linearize(problem_and_sizes: tuple[Shooting, np.ndarray], x, following, p):
    """Return derivatives and residual of a motion, both divided by the largest derivative in each
    row, with respect to the unknowns of the motion and of the following one, and the parameters."""
    problem, sizes = problem_and_sizes

    def residual(z):
        own, following, p = jnp.split(z * sizes, [x.size, 2 * x.size])
        return problem.motion_residual(jnp.concatenate([own, p]), following=following)

    return scaled_jacobian(residual, jnp.concatenate([x, following, p]) / sizes)[:2]


_observe = in_lanes(lambda problem, x, following: problem.observe(x, following))


@in_lanes
def _rate(problem: Shooting, x):
    """Return the rate of the state just before the first event."""
    clock, states = problem.parts(x)
    return problem.flight(problem.at(x), problem.legs - 1).rate(clock[0], states[0])


@in_lanes
def _on_section(problem: Shooting, x):
    """Return the state on the section with which a motion begins, else that in which it ends."""
    leg, clock = problem.legs - 1, problem.period(x)
    if begins_on_section(problem):
        leg, clock = 0, problem.parts(x)[0][0]
    return ravel_pytree(problem.state_at(x, leg, clock))[0]


def _solve_bordered(
    own: np.ndarray, after: np.ndarray, shift: np.ndarray, shared: np.ndarray, left: np.ndarray,
    right: np.ndarray, values: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return x and s with own x + after (shift x) + shared s = right in each row, and
    left (x, s) = values; several right sides, in columns.

    Only the first event of the following row occurs in `after`. The other unknowns of each row are
    eliminated, so that the dense system is small also for motions with many events.
    """
    count, width, extra = *own.shape[:2], shared.shape[2]
    joined = np.any(after != 0, axis=(0, 1))
    inner = width - int(joined.sum())
    turned, upper = np.linalg.qr(own[:, :, ~joined], mode="complete")
    turn = lambda a: np.swapaxes(turned, 1, 2) @ a
    own, after = turn(own[:, :, joined]), turn(after[:, :, joined])
    shared, right = turn(shared), turn(right)
    solve = lambda a: np.linalg.solve(upper[:, :inner], a[:, :inner])
    own_in, after_in, shared_in, right_in = (solve(a) for a in (own, after, shared, right))
    matrix = np.einsum("jab,ji->jaib", after[:, inner:], shift)
    matrix[np.arange(count), :, np.arange(count)] += own[:, inner:]
    total = count * (width - inner)
    upper_rows = np.hstack([matrix.reshape(total, total), shared[:, inner:].reshape(total, extra)])
    by_x, by_shared = left[:, :-extra].reshape(-1, count, width), left[:, -extra:]
    by_inner = by_x[:, :, ~joined]
    by_x = by_x[:, :, joined] - np.einsum("cja,jab->cjb", by_inner, own_in)
    by_x -= np.einsum("cja,jab,ji->cib", by_inner, after_in, shift, optimize=True)
    by_shared = by_shared - np.einsum("cja,jab->cb", by_inner, shared_in)
    values = values - np.einsum("cja,jab->cb", by_inner, right_in)
    found = np.linalg.solve(
        np.vstack([upper_rows, np.hstack([by_x.reshape(-1, total), by_shared])]),
        np.concatenate([right[:, inner:].reshape(total, -1), values]),
    )
    x, s = found[:total].reshape(count, width - inner, -1), found[total:]
    rows = np.empty((count, width, x.shape[2]))
    rows[:, joined] = x
    following = np.tensordot(shift, x, 1)
    rows[:, ~joined] = right_in - own_in @ x - after_in @ following - shared_in @ s
    return np.concatenate([rows.reshape(count * width, -1), s])


def begins_on_section(problem: Shooting) -> bool:
    return bool(problem.events) and problem.events[0].cycle == 0


def begin_on_section(problem: Shooting, row: Any) -> State:
    """Return a state on the section, with the machine's own modes."""
    leg = 0 if begins_on_section(problem) else problem.legs - 1
    return with_modes(problem.unravel(row), own_modes(problem.machine, problem.modes_in(leg)))


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


def angles_of(number: int) -> np.ndarray:
    """Return the angles of so many nodes, in turns."""
    return np.arange(number) / number


class Curve(NamedTuple):
    """Values of the unknowns, or their change along a family."""

    x: np.ndarray
    """Unknowns of the motion at each node, (nodes, unknowns)."""
    rotation: float
    """Rotation number, in turns."""
    p: np.ndarray
    """Parameters, (parameters,)."""

    def with_nodes(self, number: int) -> "Curve":
        return self._replace(x=interpolated(self.x, angles_of(number)))

    def towards(self, other: "Curve", share: float) -> "Curve":
        """Return the curve at a share of the way to another one."""
        nodes = max(len(self.x), len(other.x))
        here, there = self.with_nodes(nodes), other.with_nodes(nodes)
        return here.plus(share, jax.tree.map(np.subtract, there, here))

    def plus(self, share: float, change: "Curve") -> "Curve":
        return jax.tree.map(lambda a, b: a + share * b, self, change)


Condition = tuple[np.ndarray, float]
"""A linear equation between all unknowns in a row (see `Equations.pack`): coefficients, value."""


class Solved(NamedTuple):
    curve: Curve
    iterations: int
    tangent: Curve
    """The direction, of unit length, in which the last condition's value grows."""


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
        """Return the largest high mode of a curve, relative to its largest mode."""
        size = np.abs(np.fft.fft(curve.x / self.scale, axis=0)).max(axis=1)
        number = np.abs(modes(len(size)))
        largest = size[number > 0].max(initial=0.0)
        high = size[number > _TAIL * (len(size) // 2)].max()
        return float(high / largest) if largest > 0 else 1.0

    def motion(self, p: np.ndarray) -> Shooting:
        """Return the equations of the motion alone at these values of the parameters."""
        blank = np.zeros(len(self.scale))
        return self.problem.motion_at(np.append(blank, p))[0] if len(p) else self.problem

    def observe(self, curve: Curve, angles: np.ndarray | None = None) -> Any:
        """Return `Observed` of the motion from each node, or from other angles, in arrays."""
        angles = angles_of(len(curve.x)) if angles is None else angles
        x, after = (interpolated(curve.x, angles + turn) for turn in (0.0, curve.rotation))
        return _observe(self.motion(curve.p), x, after)

    def cocycle(self, curve: Curve) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivative over a period and the direction along the curve, at each node. Both
        are those of the scaled state just before the first event, at a given clock."""
        problem, slopes = self.problem, derivative(curve.x)
        begin, matrices = len(problem.events), self.observe(curve).monodromy
        along = slopes[:, begin : begin + problem.states]
        if problem.autonomous:
            ends = np.einsum("jab,jb->ja", matrices, along)
            along = interpolated(ends, angles_of(len(ends)) - curve.rotation)
        elif problem.events:
            along = along - slopes[:, :1] * _rate(self.motion(curve.p), curve.x)
        sizes = np.asarray(problem.sizes)[1:]
        return matrices * sizes / sizes[:, None], along / sizes

    def on_section(self, curve: Curve, angles: np.ndarray) -> np.ndarray:
        """Return the states on the section at some angles, (angles, states)."""
        back = 0.0 if begins_on_section(self.problem) else curve.rotation
        return _on_section(self.motion(curve.p), interpolated(curve.x, angles - back))

    def growth(self, cycle: Curve) -> float:
        """Return the greatest modulus of a multiplier of a periodic motion, a row for a period."""
        after = np.roll(cycle.x, -1, axis=0)
        found = _observe(self.motion(cycle.p), cycle.x, after).monodromy
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
            moves[1] /= np.linalg.norm(moves[1])
            move, tangent = (self.unpack(row, len(curve.x)) for row in moves)
            size = max(np.abs(move.x / self.scale).max(), *np.abs(moves[0][move.x.size :]))
            share = min(1.0, _LONGEST / size) if size > 0 else 1.0
            curve = curve.plus(share, move)
            # The next correction would be the square, if rounding does not keep it above.
            if size <= ROUNDING or (before <= ROUGHLY and size >= before):
                return Solved(curve, count, tangent)
            before = size
        return None

    def _newton(
        self, curve: Curve, conditions: Sequence[Condition], is_cycle: bool
    ) -> np.ndarray | None:
        """Return Newton's correction and the tangent (see `Solved`), as rows of unknowns."""
        count, total = len(curve.x), curve.x.size
        if is_cycle:
            shift, slope = np.roll(np.eye(count), 1, axis=1), 0 * curve.x
            conditions = [self._value_of(curve, total, curve.rotation), *conditions]
        else:
            shift = interpolated(np.eye(count), angles_of(count) + curve.rotation)
            slope = shift @ derivative(curve.x)
        own, after, by_p, residual = self._linearized(curve, shift @ curve.x)
        by_rotation = np.einsum("jab,jb->ja", after, slope / (self.scale * np.sqrt(count)))
        shared = np.concatenate([by_rotation[:, :, None], by_p], axis=2)
        row = self.pack(curve)
        misses = [coefficients @ row - value for coefficients, value in conditions]
        # Right sides: of Newton's correction, and of the tangent.
        right = np.stack([-residual, 0 * residual], axis=2)
        values = np.stack([-np.array(misses), np.eye(len(misses))[-1]], axis=1)
        left = np.stack([coefficients for coefficients, _ in conditions])
        if not all(np.isfinite(a).all() for a in (own, after, shared, right, left, values)):
            return None
        try:
            moves = _solve_bordered(own, after, shift, shared, left, right, values).T
        except np.linalg.LinAlgError:
            return None
        return moves if np.isfinite(moves).all() else None

    def _linearized(self, curve: Curve, following: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the derivatives with respect to the scaled unknowns (as packed) of each row, of
        that which follows it, and to the parameters; and the residuals."""
        (count, width), units = curve.x.shape, self.scale * np.sqrt(len(curve.x))
        shared = self.problem, np.concatenate([units, units, self.widths])
        p = np.tile(curve.p, (count, 1))
        columns, residual = _linearize(shared, curve.x, following, p)
        return *np.split(columns, [width, 2 * width], axis=2), residual

    def _value_of(self, curve: Curve, index: int, value: float) -> Condition:
        """Return the condition that an unknown of the row has a value."""
        coefficients = np.zeros(curve.x.size + 1 + len(curve.p))
        coefficients[index] = 1.0
        return coefficients, value

    def along(self, rows: np.ndarray, x: np.ndarray) -> Condition:
        """Return the condition that a curve does not move along `rows` against `x`."""
        row, values = (self.pack(Curve(a, 0.0, np.zeros(len(self.widths)))) for a in (rows, x))
        direction = row / np.linalg.norm(row)
        return direction, float(direction @ values)

    def phase(self, curve: Curve) -> Condition:
        """Return the condition that a curve does not turn in itself against this one."""
        return self.along(derivative(curve.x), curve.x)

    def across(self, curve: Curve, tangent: Curve, length: float = 0.0) -> Condition:
        """Return the condition that a curve lies in the plane across a tangent, at a distance."""
        direction = self.pack(tangent.with_nodes(len(curve.x)))
        return direction, float(direction @ self.pack(curve)) + length

    def solve_near(self, guess: Curve, value: float | None = None) -> Solved | None:
        """Solve at the guess's parameters, or at another value of the last one."""
        conditions = [self.phase(guess)]
        if len(guess.p):
            value = float(guess.p[-1]) if value is None else value
            guess = guess._replace(p=np.append(guess.p[:-1], value))
            conditions.append(self._value_of(guess, -1, value / self.widths[-1]))
        return self.solve(guess, conditions)

    def refined(self, solved: Solved | None, most: int) -> Solved | None:
        """Double the nodes until the tail is small, or more than `most` were needed; `None` if the
        equations are not solved, then or before."""
        while solved and self.tail(solved.curve) > CORRECTED:
            nodes = 2 * len(solved.curve.x) - 1
            if nodes > most:
                break
            finer = solved.curve.with_nodes(nodes)
            held = [self.across(finer, solved.tangent)] if len(finer.p) else []
            solved = self.solve(finer, [self.phase(finer), *held])
        return solved

    def rotating_mode(self, point: Curve) -> tuple[float, np.ndarray]:
        """Return rotation number and complex mode of the infinitesimal curves around a periodic
        motion, one row, in scaled unknowns; those of its complex multiplier closest to modulus 1.
        """
        from scipy.linalg import eig  # slow to load

        own, after, *_ = self._linearized(point, point.x)
        values, vectors = eig(own[0], -after[0])  # pyright: ignore
        turns = np.isfinite(values) & (np.imag(values) > ROUGHLY)
        i = int(np.argmin(np.where(turns, np.abs(np.abs(values) - 1), np.inf)))
        return float(np.angle(values[i]) / (2 * np.pi)), vectors[:, i]
