"""Machines defined by masses and applied forces; inertial terms follow from the masses.

With coordinates q, velocities v, the mass matrix M(q) and kinetic energy ½ vᵀMv, Lagrange's
equations are M v' + h = f. Here f are applied forces, and h_i = Σ_k v_k (∂M/∂q_k v)_i - ½
vᵀ(∂M/∂q_i) v. The force of a contact with gap g(q), J = ∇g, acts along M⁻¹Jᵀ on a mass 1/(J M⁻¹Jᵀ).
"""

import abc
import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from math import pi
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._checks import concrete, is_traced, returned
from .._types import Scalar, State
from ..lanes import dependent_results
from .base import AbstractMachine, cached_in_trace, contacts_in
from .contacts import check_takes
from .coordinates import Coordinate, Row, component
from .elimination import Matrix, dot, is_known, minus_product, solved, sum_of, times
from .leaves import split_index
from .overrides import overridden
from .state import State as Named
from .state import like
from .stop import Wall

# Errors of the position of a prescribed coordinate decay by exp(-2π), 2e-3, in a cycle. A choice:
# twice that rate takes 1.5 times as many steps.
_DECAY = 2 * pi


class Mechanical(AbstractMachine):
    """A machine of masses, defined by coordinates, masses and the forces between contacts.

    Its state has the coordinates by name, and their velocities as `v`: `z.y`, `z.v.y`. Method `at`
    returns a state: `machine.at(y=0.1, v=dict(y=1.0))`.

    | definition | meaning |
    |---|---|
    | `q` | the names of its coordinates; `"x[40]"` is an array of 40, `x` |
    | `mass` | the mass of each, or a mass matrix: numbers, or a method `mass(q)` |
    | `force(t, q, v)` | the applied force on each, by name |
    | `prescribed(t)` | the positions of coordinates with given motion, by name: moving walls |
    | `cycle`, `contacts`, `events`, `modes` | as of every machine |

    A contact is `on` a coordinate, `on="y"`, or a gap of several, `on=lambda q: q.left - q.right`.
    The momentum of an impact, the effective mass (`Run.impact_energy`) and inertial terms follow
    from the masses. Prescribed coordinates have no entries in `mass` and `force`.

    An array of coordinates has arrays of forces and masses, and contacts such as `on="x[39]"`. Then
    the masses cannot be a matrix.
    """

    q: ClassVar[tuple[str, ...]]
    mass: ClassVar[Any]

    @abc.abstractmethod
    def force(self, *args: Any, **kwargs: Any) -> Any:
        """Return the applied force on each coordinate, by name: `force(t, q, v)`. Discrete modes of
        the machine are further arguments."""

    def prescribed(self, t: Scalar) -> dict[str, Any]:
        """Return the positions of the coordinates with given motion, as functions of time."""
        return {}

    def at(self, v: Any = None, **places: Any) -> Any:
        """Return a state with these positions, and in `v` velocities, by name. Others are 0, or for
        prescribed coordinates those at t = 0."""
        names, v = self._free_names, {} if v is None else v
        if not isinstance(v, Mapping | Named):
            raise TypeError(
                f"Argument `v` must be velocities by name, dict({names[0]}=...): {v!r}."
            )
        v = dict(vars(v) if isinstance(v, Named) else v)
        wrong = next((x for x in (*places, *v) if x not in names), None)
        if wrong in self._q_names:
            raise ValueError(
                f"The motion of {wrong!r} is prescribed by the machine. Leave it out: a state has "
                f"free values of {', '.join(names)} alone."
            )
        if wrong is not None:
            raise ValueError(
                f"{wrong!r} is not one of the coordinates {', '.join(names)}. Give velocities by "
                f"name in `v`: `at({names[0]}=0.1, v=dict({names[0]}=1.0))`."
            )
        zeros = {x: jnp.zeros(shape) if shape else 0.0 for x, shape in self._q_shapes.items()}
        at, rate = zeros | places, zeros | v
        for name, zero in zeros.items():
            if self._q_shapes[name]:  # one number holds for all
                at[name], rate[name] = zero + at[name], zero + rate[name]
        return self._with_prescribed(0.0, Named(**at, v=Named(**rate)))

    def _with_prescribed(self, t: Any, state: Any) -> Any:
        """Return a state with the prescribed positions and velocities at a time."""
        if type(self).prescribed is Mechanical.prescribed:
            return state
        t = jnp.asarray(t, float)
        places, rates = jax.jvp(self.prescribed, (t,), (jnp.ones_like(t),))
        return state.replace(**places, v=state.v.replace(**rates))

    def start(self) -> Any:
        """Return the state at rest with all coordinates zero."""
        return self.at()

    @property
    def _q_names(self) -> tuple[str, ...]:
        """The names of the coordinates."""
        return tuple(self._q_shapes)

    @property
    def _q_shapes(self) -> dict[str, tuple[int, ...]]:
        """The shapes of the coordinates, by name; `()` for one number."""
        if not hasattr(self, "q"):
            raise TypeError(
                f'A {type(self).__name__} must have `q`: write `q = ("x", "y")` in the class, the '
                "names of its coordinates."
            )
        given = (self.q,) if isinstance(self.q, str) else self.q
        if not isinstance(given, tuple | list):
            raise TypeError(
                f"`q` of a {type(self).__name__} must be the names of its coordinates, but is "
                f"{given!r}. Give a parameter another name."
            )
        shapes = dict(map(split_index, given))
        if len(shapes) < len(given) or "v" in shapes:
            raise ValueError(
                f"`q` of a {type(self).__name__} must have different names, and none of them `v`, "
                f"but is {given}."
            )
        return shapes

    @property
    def _free_names(self) -> tuple[str, ...]:
        """The names of the coordinates whose motion is not prescribed."""
        if type(self).prescribed is Mechanical.prescribed:
            return self._q_names
        whose = f"`prescribed` of a {type(self).__name__}"
        what = f"positions by name, `dict({self._q_names[-1]}=...)`"
        given = returned(jax.eval_shape(self.prescribed, 0.0), whose, what)
        if not isinstance(given, Mapping):
            raise TypeError(f"{whose} must return {what}.")
        unknown = [x for x in given if x not in self._q_names]
        if unknown:
            raise ValueError(
                f"{whose} returned {unknown[0]!r}, which is not one of the coordinates "
                f"{', '.join(self._q_names)}."
            )
        return tuple(x for x in self._q_names if x not in given)

    def field(self, t: Scalar, state: State, *modes: Scalar) -> Any:
        """Return the rate of the state: velocities, and accelerations by Lagrange's equations."""
        q, v, names = self._places(state), state.v, self._free_names
        whose = f"`force` of a {type(self).__name__}"
        free = Named(**{name: getattr(v, name) for name in names})
        try:
            given = self.force(t, q, v, *modes)
        except TypeError:
            check_takes(self.force, whose, "`t`, `q`, `v`", (t, q, v, *modes), len(modes))
            raise
        what = f"forces by name, `dict({', '.join(f'{name}=...' for name in names)})`"
        applied = like(free, returned(given, whose, what), whose)
        if not isinstance(applied, Named):
            raise TypeError(f"{whose} must return {what}.")
        known = {x: f for x, f in given.items() if is_known(f)} if isinstance(given, dict) else {}
        applied = vars(applied) | known
        both = zip(applied.values(), self._inertial(q, v), strict=True)
        net_forces = [minus_product(f, 1.0, h) for f, h in both]
        rates = dict(zip(names, solved(self._masses(q), net_forces), strict=True))
        if len(names) < len(self._q_names):
            rates |= self._prescribed_accelerations(t, q, v)
        zero, v_rates = jax.tree.map(jnp.zeros_like, state), {x: rates[x] for x in self._q_names}
        return _in_state(zero, *self._by_s(t, state, v, Named(**v_rates)))

    def _by_s(self, s: Scalar, state: State, *rates: Named) -> Sequence[Named]:
        """Return rates with respect to `s`, which need not be time."""
        pace = self.pace(s, state)
        if pace is None:
            return rates
        if type(self).prescribed is not Mechanical.prescribed:
            raise ValueError(
                f"`pace` of a {type(self).__name__} must be left out, since it has `prescribed`. "
                "Write the motion of a wall as a function of time."
            )
        return jax.tree.map(lambda x: pace * x, rates)

    def _prescribed_accelerations(self, t: Scalar, q: Named, v: Named) -> dict[str, Any]:
        """Return the accelerations of prescribed coordinates. They let errors of steps decay.
        Otherwise errors would add up, and an orbit would be neutrally stable in them."""
        one, rate = jnp.ones_like(t), _DECAY / self.cycle

        def motion(t: Scalar) -> Any:
            return jax.jvp(self.prescribed, (t,), (one,))

        (positions, speeds), (_, accelerations) = jax.jvp(motion, (t,), (one,))
        return {
            name: acceleration
            + 2 * rate * (speeds[name] - getattr(v, name))
            + rate**2 * (positions[name] - getattr(q, name))
            for name, acceleration in accelerations.items()
        }

    def _places(self, state: State) -> Named:
        """Return the coordinates in a state, without velocities."""
        return Named(**{name: getattr(state, name) for name in self._q_names})

    def _masses(self, q: Named) -> Matrix:
        """Return the mass matrix at these coordinates, as rows of numbers."""
        given = _mass_of(self)
        if given is None:
            raise TypeError(
                f"A {type(self).__name__} must have `mass`: one for each of its coordinates, in "
                "the class or by a method `mass(self, q)`."
            )
        shapes = {name: self._q_shapes[name] for name in self._free_names}
        whose = type(self).__name__
        if callable(given):
            what = f"one for each of {', '.join(shapes)}"
            given = returned(given(q), f"`mass` of a {whose}", what)
        return matrix_of(given, shapes, whose)

    def _inertial(self, q: Named, v: Named) -> list[Any]:
        """Return h = dM/dt v - ½ ∂(vᵀMv)/∂q of Lagrange's equations; 0 with constant masses."""
        names = self._free_names
        if not callable(_mass_of(self)):
            return [0.0 for _ in names]
        speeds, found = [getattr(v, name) for name in names], dict.fromkeys(names, 0.0)

        def momenta(q: Named) -> list[Any]:
            rows = (zip(row, speeds, strict=True) for row in self._masses(q))
            return [sum_of(times(m, x) for m, x in row if not is_known(m)) for row in rows]

        def twice_energy(q: Named) -> Any:
            return dot(momenta(q), speeds)

        for name, acts in _dependence(momenta, q).items():
            if not any(acts):
                continue
            speed = getattr(v, name)
            is_array = jnp.ndim(speed) > 0
            slopes = _rate_along(momenta, q, name, speed if is_array else jnp.ones_like(speed))
            slopes = [x if y else 0.0 for x, y in zip(slopes, acts, strict=True)]
            pull = _derivative(twice_energy, q, name) if is_array else dot(slopes, speeds)
            for x, slope in zip(names, slopes, strict=True):
                if not is_known(slope):
                    found[x] = sum_of((found[x], slope if is_array else slope * speed))
            if name in found:
                found[name] = found[name] - 0.5 * pull
        return list(found.values())

    def _coordinate_on(self, on: Any, mass: Any = None) -> Coordinate:
        on = _as_gap(self, on)
        return Coordinate(
            functools.partial(_position, self, on),
            functools.partial(_velocity, self, on),
            functools.partial(_placed, self, on),
            functools.partial(_effective_mass, self, on),
            lambda state: _row(self, on, state).push,
            functools.partial(_row, self, on),
            overridden(self, AbstractMachine, "pace") is None,
        )

    def _names_on(self, on: Any) -> tuple[str, str] | None:
        name = _coordinate_name(self, on)
        return None if name is None else (name, f"v.{name}")


@cached_in_trace
def _mass_of(machine: Any) -> Any:
    return getattr(machine, "mass", None)


def _coordinate_name(machine: Mechanical, on: Any) -> str | None:
    """Return the name of a coordinate, or `None` for a gap. Without stops, the first number of the
    first coordinate is the one of which extremes are recorded."""
    name = machine._q_names[0] if on is None else on
    if on is None and not any(isinstance(x, Wall) for x in contacts_in(machine)):
        name += str([0] * len(machine._q_shapes[name])) * bool(machine._q_shapes[name])
    elif on is None and len(machine._q_names) > 1:
        raise ValueError(
            f"Argument `on` of a contact of a {type(machine).__name__} must be given: "
            f"`on={name!r}`, or another of the coordinates {', '.join(machine._q_names)}."
        )
    if callable(name):
        return None
    base, index = split_index(name) if isinstance(name, str) else ("", ())
    if len(machine._q_shapes.get(base, (0,))) != len(index):
        names = [x + str([0] * len(shape)) * bool(shape) for x, shape in machine._q_shapes.items()]
        raise ValueError(
            f"Argument `on` or `along` of a contact must be one of the coordinates "
            f"{', '.join(names)}, or a function of them, but got {on!r}."
        )
    return name


class _Gap(NamedTuple):
    """A function that contacts are `on`, or have friction `along`, and its number among these.

    A step of a block on two corners asks for rates and pushes of its gaps some hundred times.
    Inline they and their derivatives were half of the equations of its `find_orbit`; by its number
    a function is traced once for equal machines.
    """

    function: Callable[[Named], Any]
    number: int | None

    def __call__(self, q: Named) -> Any:
        return self.function(q)


@cached_in_trace
def _functions_in(machine: Any) -> tuple[Any, ...]:
    parts = contacts_in(machine)
    return tuple(y for x in parts for y in map(vars(x).get, ("on", "along")) if callable(y))


def _as_gap(machine: Mechanical, on: Any) -> Any:
    """Return what a contact is `on`: a function as a `_Gap`."""
    if not callable(on):
        return on
    return _Gap(on, next((i for i, x in enumerate(_functions_in(machine)) if x is on), None))


def _once(function: Callable[..., Any]) -> Callable[..., Any]:
    """Trace a function of a machine, what a contact is on, and a state once for each gap."""

    @eqx.filter_jit
    def of_number(machine: Mechanical, number: int, state: Any) -> Any:
        return function(machine, _functions_in(machine)[number], state)

    @functools.wraps(function)
    def of_gap(machine: Mechanical, on: Any, state: Any) -> Any:
        if is_traced(machine, state) and isinstance(on, _Gap) and on.number is not None:
            return of_number(machine, on.number, state)
        return function(machine, on, state)

    return of_gap


@_once
def _position(machine: Mechanical, on: Any, state: State) -> Any:
    name = _coordinate_name(machine, on)
    return on(machine._places(state)) if name is None else component(name, state)


@_once
def _velocity(machine: Mechanical, on: Any, state: State) -> Any:
    name, v = _coordinate_name(machine, on), state.v
    if name is not None:
        return component(name, v)
    return jax.jvp(on, (machine._places(state),), (v,))[1]


def _gradient(machine: Mechanical, on: Any, q: Named) -> list[Any]:
    """Return J, the gradient of a gap; its constant entries are plain numbers."""
    name, names = _coordinate_name(machine, on), machine._q_names
    if name is not None:
        base, index = split_index(name)
        one = jnp.zeros_like(getattr(q, base)).at[index].set(1.0) if index else 1.0
        return [one if x == base else 0.0 for x in names]
    return [_derivative(on, q, x) if any(acts) else 0.0 for x, acts in _dependence(on, q).items()]


def _dependence(function: Callable[[Named], Any], q: Named) -> dict[str, list[bool]]:
    """Return for each coordinate whether each result of a function may depend on it."""
    traced, names = jax.make_jaxpr(function)(q).jaxpr, tuple(vars(q))
    marks = {name: [name == x for x in names] for name in names}
    return {name: dependent_results(traced, x, smooth=False) for name, x in marks.items()}


def _derivative(function: Callable[[Named], Any], q: Named, name: str) -> Any:
    """Return the derivative of a number with respect to a coordinate."""
    value = getattr(q, name)
    if jnp.ndim(value):
        return jax.grad(lambda x: function(q.replace(**{name: x})))(value)
    return _rate_along(function, q, name, jnp.ones_like(value))


def _rate_along(function: Callable[[Named], Any], q: Named, name: str, speed: Any) -> Any:
    """Return the rate of change of a function if one coordinate moves at this speed."""
    return jax.jvp(lambda x: function(q.replace(**{name: x})), (getattr(q, name),), (speed,))[1]


@_once
def _push(machine: Mechanical, on: Any, q: Named) -> tuple[list[Any], Any, list[Any]]:
    """Return M⁻¹Jᵀ/(J M⁻¹Jᵀ), the change of the velocities for a unit change of a gap's velocity;
    the effective mass 1/(J M⁻¹Jᵀ); and J."""
    names, gradient = machine._free_names, _gradient(machine, on, q)
    by_name = dict(zip(machine._q_names, gradient, strict=True))
    slopes = [by_name[name] for name in names]
    push = solved(machine._masses(q), slopes)
    gain = dot(slopes, push)
    if is_known(gain):
        raise ValueError(
            f"A contact of a {type(machine).__name__} is `on` no coordinate that it could move. "
            "Its gap must depend on a coordinate that is not prescribed."
        )
    pushes = {name: 0.0 if is_known(x) else x / gain for name, x in zip(names, push, strict=True)}
    return [pushes.get(name, 0.0) for name in machine._q_names], 1 / gain, gradient


def _effective_mass(machine: Mechanical, on: Any, s: Scalar, state: State) -> Any:
    return _push(machine, on, machine._places(state))[1]


def _row(machine: Mechanical, on: Any, state: State) -> Row:
    name = _coordinate_name(machine, on)
    push, mass, slopes = _push(machine, on, machine._places(state))
    push = dict(zip(machine._q_names, push, strict=True))
    if name in push:
        push[name] = 1.0
    zero = jax.tree.map(lambda x: np.zeros(jnp.shape(x), jnp.result_type(x)), state)

    def as_velocities(values: Iterable[Any]) -> Any:
        both = zip(vars(machine._places(zero)).items(), values, strict=True)
        v = {x: (jnp if isinstance(value, jax.Array) else np).full_like(y, value)
             for (x, y), value in both}  # fmt: skip
        return zero.replace(v=Named(**v))

    return Row(as_velocities(push.values()), mass, as_velocities(slopes))


def _placed(machine: Mechanical, on: Any, state: State, Y: Any, V: Any) -> Any:
    """Return the state with another position and velocity of a gap, by the least change in the norm
    of the masses. A coordinate by name is set exactly."""
    name, q = _coordinate_name(machine, on), machine._places(state)
    q = _moved(q, _push(machine, on, q)[0], Y - on(q)) if name is None else _replaced(q, name, Y)
    push, v = _push(machine, on, q)[0], state.v
    v = _moved(v, push, V - _velocity(machine, on, _in_state(state, q, v)))
    if name is not None:
        v = _replaced(v, name, V)
    return _in_state(state, q, v)


def _in_state(state: State, q: Named, v: Named) -> State:
    return state.replace(**vars(q), v=v)


def _replaced(x: Named, name: str, value: Any) -> Named:
    base, index = split_index(name)
    return x.replace(**{base: getattr(x, base).at[index].set(value) if index else value})


def _moved(x: Named, push: list[Any], amount: Any) -> Named:
    both = zip(vars(x).items(), push, strict=True)
    return Named(**{name: y if is_known(p) else y + p * amount for (name, y), p in both})


def matrix_of(given: Any, shapes: Mapping[str, tuple[int, ...]], whose: str) -> Matrix:
    """Return masses as a matrix, from one per coordinate, by name or in order, or from rows.
    **Raises:** `ValueError` for a wrong number of them, or a matrix for arrays."""
    n = len(shapes)
    if isinstance(given, Mapping):
        given = [given[x] for x in shapes]
    elif isinstance(given, Named):
        given = [getattr(given, x) for x in shapes]
    alone = not isinstance(given, Sequence) and jnp.ndim(given) == 0
    rows = [given] if alone or (n == 1 and _is_mass(given, *shapes.values())) else list(given)
    if len(rows) != n:
        raise ValueError(
            f"`mass` of a {whose} must be one for each of {', '.join(shapes)}, or {n} rows, but "
            f"has {len(rows)}."
        )
    if all(map(_is_mass, rows, shapes.values())):
        least = min((np.min(x) for x in map(concrete, rows) if x is not None), default=1.0)
        if least <= 0:
            raise ValueError(f"`mass` of a {whose} must be positive, but has {least:g}.")
        return [[rows[i] if i == j else 0.0 for j in range(n)] for i in range(n)]
    if any(shapes.values()):
        raise ValueError(
            f"`mass` of a {whose} must be a number or an array for each of its coordinates, since "
            "some are arrays. Write a machine with a matrix of them as an `AbstractMachine`, or a "
            "linear one as a `vi.machines.Structure`."
        )
    wrong = [len(row) for row in rows if len(row) != n]
    if wrong:
        raise ValueError(
            f"`mass` of a {whose} must be a matrix with {n} columns, but has a row of {wrong[0]}."
        )
    return [[row[j] for j in range(n)] for row in rows]


def _is_mass(x: Any, shape: tuple[int, ...]) -> bool:
    return not isinstance(x, list | tuple) and jnp.shape(x) in ((), shape)
