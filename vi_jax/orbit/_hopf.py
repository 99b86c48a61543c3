"""Where the cycle of an autonomous machine shrinks onto an equilibrium.

Close to such a place the equations of the cycle cannot be solved: the equilibrium solves them as
well, with every period, and where the section is a velocity for every number of the machine. So it
is the equilibrium that is solved for there, and the number at which two of its eigenvalues are
imaginary.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from .._types import Scalar, Vector
from ..machine import AbstractMachine, renews, section_in
from ._corrector import Step, observe, on_host
from ._flight import section_of
from ._shooting import Shooting, Unknowns

# The motion that stands for the branch there has so much of the size of the one before it. This and
# the numbers below are choices.
_SMALL = 1e-5

# By how much an eigenvalue's period may differ from that of the last motion, as a share of it.
_ALIKE = 0.2

# Zero, as a share of what it is beside.
_ZERO = 1e-9

# A multiplier is 1 within this.
_ONE = 1e-6


def _rate(problem: Shooting, machine: AbstractMachine, u: Vector) -> Vector:
    moving = problem.flight(machine, 0).smooth
    return ravel_pytree(moving.field(jnp.zeros((), u.dtype), problem.unravel(u)))[0]


@on_host
def _leaving(problem: Shooting, x: Vector) -> tuple[Vector, Scalar]:
    """How fast a motion leaves its section, and its period."""
    machine = problem.at(x)
    u = problem.after(machine, 0, jnp.zeros((), x.dtype), problem.parts(x)[1][0])
    return _rate(problem, machine, u), problem.period(x)


def size_of(problem: Shooting, x: Unknowns) -> float:
    """How far an autonomous motion would get in its period as fast as it leaves the section."""
    rate, period = _leaving(problem, x)
    return float(np.linalg.norm(rate) * period)


def hopf_between(problem: Shooting, here: Step, new: Step) -> Step | None:
    """Where the cycle shrinks onto an equilibrium between two points of a branch; `None` if it
    does not.

    **Returns:** a motion of hardly any size about the equilibrium whose eigenvalues ±iω are
    imaginary. One of its multipliers is 1, which is checked.
    """
    if problem.events != (section_of(problem.machine, 0),) or renews(problem.machine):
        return None
    rates = [_leaving(problem, step.x)[0] for step in (here, new)]
    if np.dot(*rates) >= 0:
        return None  # beyond an equilibrium the motion is turned round
    size, other = np.linalg.norm(rates, axis=1)
    guess = here.x + size / (size + other) * (new.x - here.x)
    found = _imaginary(problem, guess)
    if found is None or np.linalg.norm(found[0] - guess) > np.linalg.norm(new.x - here.x):
        return None
    return _about(problem, here, *found)


@on_host
def _linear(problem: Shooting, x: Vector) -> tuple[Array, Scalar, Vector]:
    """Derivative of the field in the state of `x`, the section there and its derivative."""
    machine, u = problem.at(x), problem.parts(x)[1][0]
    section, slope = jax.value_and_grad(lambda u: section_in(machine, problem.unravel(u)))(u)
    return jax.jacfwd(partial(_rate, problem, machine))(u), section, slope


@on_host
def _lacks(problem: Shooting, y: Vector, scale: Vector, like: Array) -> tuple[Vector, Array]:
    """What (u, p, ω, Re v, Im v) = y·scale lacks to be an equilibrium u with an eigenvector v to
    iω, in length and phase like another one, all relative to its size; and the derivative of
    that."""
    n = problem.states

    def missing(y):
        at, (c, d) = y * scale, y[n + 2 :].reshape(2, n)
        u, turn, (a, b) = at[:n], at[n + 1], at[n + 2 :].reshape(2, n)
        field = partial(_rate, problem, problem.at(at[: n + 1]))
        matrix = jax.jacfwd(field)(u)
        rates = jnp.stack([field(u), matrix @ a + turn * b, matrix @ b - turn * a])
        sized = jnp.stack([like[0] @ c + like[1] @ d - 1, like[0] @ d - like[1] @ c])
        return jnp.concatenate([(rates / (scale[:n] * scale[n + 1])).ravel(), sized])

    return missing(y), jax.jacfwd(missing)(y)


def _imaginary(problem: Shooting, guess: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """The equilibrium near a guess with a pair of imaginary eigenvalues, as the unknowns of a
    motion there, and its eigenvector."""
    n, turn, matrix = problem.states, 2 * np.pi / guess[0], _linear(problem, guess)[0]
    if not np.isfinite(matrix).all():
        return None
    sizes = problem.scale[1 : n + 1]
    scale = np.concatenate([problem.scale[1:], [turn], sizes, sizes])
    values, vectors = np.linalg.eig(matrix * sizes / sizes[:, None])
    first = vectors[:, np.argmin(np.abs(values - 1j * turn))]
    like = np.stack([np.real(first), np.imag(first)])
    y, size = np.concatenate([guess[1:] / scale[: n + 1], [1.0], like.ravel()]), np.inf
    for _ in range(20):
        missing, jacobian = _lacks(problem, y, scale, like)
        if not (np.isfinite(missing).all() and np.isfinite(jacobian).all()):
            return None
        move = np.linalg.lstsq(jacobian, missing)[0]  # the smallest, where a component is neutral
        y, size = y - move, np.abs(move).max()
        if size <= 1e-14:
            break
    if not size < _ZERO or abs(y[n + 1] - 1) >= _ALIKE:
        return None
    y = y * scale
    vector = y[n + 2 : 2 * n + 2] + 1j * y[2 * n + 2 :]
    return np.append(2 * np.pi / y[n + 1], y[: n + 1]), vector / np.linalg.norm(vector)


def _about(problem: Shooting, here: Step, x: np.ndarray, vector: np.ndarray) -> Step | None:
    """A motion of hardly any size about an equilibrium, at the moment at which it passes the
    section."""
    _, section, slope = _linear(problem, x)
    seen, steep = slope @ vector, np.linalg.norm(slope)
    apart = np.linalg.norm(here.x[1:-1] - x[1:-1])
    if abs(seen) <= _ZERO * steep or abs(section) > _ZERO * steep * apart:
        return None  # the section does not see it
    # Of all the phases of the linear motion the one in which the section rises through zero.
    way = (vector * (-1j * np.conj(seen))).real
    way = np.concatenate([[0.0], way / np.linalg.norm(way), [0.0]])
    x = x + _SMALL * apart * way
    found = here._replace(x=x, tangent=-way, seen=observe(problem, x))
    return found if np.abs(found.seen.multipliers - 1).min() < _ONE else None
