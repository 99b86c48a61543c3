"""Where the cycle of an autonomous machine shrinks onto an equilibrium.

Close to such a place the equations of the cycle cannot be solved: the equilibrium solves them as
well, with every period, and where the section is a velocity for every number of the machine. So it
is the equilibrium that is solved for there, and the number at which two of its eigenvalues are
imaginary.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from .._types import Scalar, Vector
from ..machine import AbstractMachine, renews, section_in
from ._corrector import Step, observe, on_host
from ._flight import section_of
from ._shooting import Shooting

# The motion that stands for the branch there has so much of the size of the one before it. This and
# the numbers below are choices.
_SMALL = 1e-5

# By how much an eigenvalue's period may differ from that of the last motion, as a share of it.
_ALIKE = 0.2

# Zero, as a share of what it is beside.
_ZERO = 1e-9

# A multiplier is 1 within this.
_ONE = 1e-6


@on_host
def _size(problem: Shooting, x: Vector) -> Scalar:
    machine = problem.at(x)
    u = problem.after(machine, 0, jnp.zeros((), x.dtype), problem.parts(x)[1][0])
    return jnp.linalg.norm(_rate(problem, machine, u)) * problem.period(x)


@on_host
def _flow(problem: Shooting, x: Vector, u: Vector) -> tuple[Vector, Array, Scalar, Vector]:
    """Field and section in the state u, each with its derivatives by it."""
    machine = problem.at(x)
    section, slope = jax.value_and_grad(lambda u: section_in(machine, problem.unravel(u)))(u)
    jacobian = jax.jacfwd(lambda u: _rate(problem, machine, u))(u)
    return _rate(problem, machine, u), jacobian, section, slope


def _rate(problem: Shooting, machine: AbstractMachine, u: Vector) -> Vector:
    moving = problem.flight(machine, 0).smooth
    return ravel_pytree(moving.field(jnp.zeros((), u.dtype), problem.unravel(u)))[0]


def size_of(problem: Shooting, x: np.ndarray | Array) -> float:
    """How far an autonomous motion would get in its period as fast as it leaves the section."""
    return float(_size(problem, x))


def hopf_between(problem: Shooting, here: Step, new: Step) -> Step | None:
    """Where the cycle shrinks onto an equilibrium between two points of a branch; `None` if it
    does not.

    **Returns:** a motion of hardly any size about the equilibrium whose eigenvalues ±iω are
    imaginary. One of its multipliers is 1, which is checked.
    """
    if problem.events != (section_of(problem.machine, 0),) or renews(problem.machine):
        return None
    rates = [_flow_at(problem, step.x, _state(problem, step.x))[0] for step in (here, new)]
    if np.dot(*rates) >= 0:
        return None  # beyond an equilibrium the motion is turned round
    size, other = np.linalg.norm(rates, axis=1)
    guess = here.x + size / (size + other) * (new.x - here.x)
    found = _imaginary(problem, guess)
    if found is None or np.linalg.norm(found.x - guess) > np.linalg.norm(new.x - here.x):
        return None
    return _about(problem, here, found)


class _Equilibrium(NamedTuple):
    """An equilibrium, with that of its eigenvalues which turns as the cycle does."""

    x: np.ndarray
    """The unknowns of a motion there: period, state, parameter."""
    value: complex
    vector: np.ndarray
    section: float
    slope: np.ndarray
    """Derivative of the section by the state."""


def _state(problem: Shooting, x: np.ndarray | Array) -> np.ndarray:
    return np.asarray(x)[1 : 1 + problem.states]


def _flow_at(problem: Shooting, x: np.ndarray | Array, u: np.ndarray) -> list[np.ndarray]:
    return [np.asarray(a) for a in _flow(problem, jnp.asarray(x), jnp.asarray(u))]


def _imaginary(problem: Shooting, guess: np.ndarray) -> _Equilibrium | None:
    """The equilibrium near a guess with a pair of imaginary eigenvalues."""
    from scipy.optimize import newton  # slow to load

    turn, known = 2 * np.pi / guess[0], [guess]
    found: list[_Equilibrium] = []

    def growth(parameter: float) -> float:
        there = _equilibrium(problem, np.append(known[-1][:-1], parameter), turn)
        if there is None:
            return np.nan
        known.append(there.x)
        found.append(there)
        return there.value.real

    near = guess[-1] + 1e-6 * (abs(guess[-1]) or 1.0)
    root: Any = newton(growth, guess[-1], x1=near, tol=1e-300, rtol=1e-14, disp=False)
    real = abs(growth(float(root)))
    close = found and abs(found[-1].value - 1j * turn) < _ALIKE * turn
    return found[-1] if close and real < _ZERO * turn else None


def _equilibrium(problem: Shooting, x: np.ndarray, turn: float) -> _Equilibrium | None:
    """The equilibrium near the state in `x`, at its parameter, by Newton's method, and its
    eigenvalue nearest to i `turn`; `None` if there is none, or only real ones."""
    u = _state(problem, x)
    for _ in range(20):
        rate, jacobian, *_ = _flow_at(problem, x, u)
        if not (np.isfinite(rate).all() and np.isfinite(jacobian).all()):
            return None
        move = np.linalg.lstsq(jacobian, rate)[0]
        u = u - move
        if np.abs(move).max() <= 1e-14 * np.abs(u).max():
            break
    _, jacobian, section, slope = _flow_at(problem, x, u)
    if not np.isfinite(jacobian).all():
        return None
    values, vectors = np.linalg.eig(jacobian)
    i = int(np.argmin(np.abs(values - 1j * turn)))
    if not values[i].imag > 0:
        return None
    x = np.concatenate([[2 * np.pi / values[i].imag], u, x[-1:]])
    return _Equilibrium(x, complex(values[i]), vectors[:, i], float(section), slope)


def _about(problem: Shooting, here: Step, there: _Equilibrium) -> Step | None:
    """A motion of hardly any size about an equilibrium, at the moment at which it passes the
    section."""
    seen, steep = there.slope @ there.vector, np.linalg.norm(there.slope)
    apart = np.linalg.norm(_state(problem, here.x) - _state(problem, there.x))
    if abs(seen) <= _ZERO * steep or abs(there.section) > _ZERO * steep * apart:
        return None  # the section does not see it
    # Of all the phases of the linear motion the one in which the section rises through zero.
    way = (there.vector * (-1j * np.conj(seen))).real
    way = np.concatenate([[0.0], way / np.linalg.norm(way), [0.0]])
    x = there.x + _SMALL * apart * way
    found = here._replace(x=x, tangent=-way, seen=observe(problem, x))
    return found if np.abs(found.seen.multipliers - 1).min() < _ONE else None
