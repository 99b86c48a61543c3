"""Ten machines in which time and each component have units of their own, as parameters: a change of
these, of the section or of the order of contacts and events does not change an answer."""

import itertools
import math
from collections.abc import Iterator
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import vi_jax as vi

FACTORS = 1e-6, 1e6


def ordered(is_flipped, *parts):
    return parts[::-1] if is_flipped else parts


class _Numbers(eqx.Module):
    scales: Any
    p: Any
    phase: Any = 0.0
    time: Any = 1.0
    is_flipped: bool = eqx.field(static=True, default=False)

    length: ClassVar[float | None] = None
    """The cycle of a driven machine in the first unit of time."""
    names: ClassVar[tuple[str, ...]]
    begins: ClassVar[tuple[float, ...]]
    value: ClassVar[float]
    """The parameter p."""
    bounds: ClassVar[tuple[float, float]]
    """Its interval."""
    linked: ClassVar[tuple[tuple[int, ...], ...]] = ()
    """Components with one unit."""

    @property
    def cycle(self):
        return self.length * self.time


class _InUnits(_Numbers, vi.AbstractMachine):
    def start(self):
        return vi.State(**{n: self.scales[i] * self.begins[i] for i, n in enumerate(self.names)})

    def field(self, t, z, *modes):
        values = [getattr(z, n) / self.scales[i] for i, n in enumerate(self.names)]
        rates = self.rates(t / self.time, *values, *modes)
        return {n: self.scales[i] * rates[i] / self.time for i, n in enumerate(self.names)}

    def row(self, state):
        """Return a state in the first units."""
        return np.stack([getattr(state, n) / self.scales[i] for i, n in enumerate(self.names)])


class Struck(_InUnits):
    """A body between two stops, a filter and a slow sum."""

    names, begins, value, bounds = ("x", "u", "q", "w"), (0.1, 0.2, 0.0, 0.0), 0.6, (0.45, 0.9)
    length = 2 * np.pi / 0.8

    @property
    def contacts(self):
        on, x = ("x", "u"), self.scales[0]
        left = vi.RigidStop(1.2 * x, 0.5, "left", on=on)
        return ordered(self.is_flipped, vi.RigidStop(self.p * x, 0.7, on=on), left)

    def rates(self, t, x, u, q, w):
        push = jnp.cos(0.8 * t + self.phase) - x - 0.1 * u - 0.2 * q
        return u, push, 0.5 * (x - q), 0.2 * (x * x - w)


class Rubbed(_InUnits):
    """Dry friction next to a stop, with a pressure."""

    names, begins, value, bounds = ("x", "u", "P", "w"), (0.1, 0.2, 100.0, 0.0), 0.4, (0.1, 0.8)
    length = 2 * np.pi / 0.4

    @property
    def contacts(self):
        x, u, *_ = self.scales
        rubs = vi.DryFriction(self.p * u / self.time, on="u")
        return ordered(self.is_flipped, rubs, vi.RigidStop(0.9 * x, 0.6, on=("x", "u")))

    def rates(self, t, x, u, P, w):
        push = 1.1 * jnp.cos(0.4 * t + self.phase) - x + 0.05 * (P - 100)
        return u, push, 0.5 * (x - (P - 100)), 0.2 * (x * x - w)


class Cushioned(_InUnits):
    """Soft stops on both sides."""

    names, begins, value, bounds = ("x", "u", "P", "w"), (0.1, 0.2, 100.0, 0.0), 0.5, (0.3, 0.9)
    linked = ((0, 1),)
    length = 2 * np.pi / 0.9

    @property
    def contacts(self):
        x, time, more = self.scales[0], self.time, {"adhesive": False, "on": ("x", "u")}
        return ordered(
            self.is_flipped,
            vi.SoftStop(self.p * x, 40.0 / time**2, damping=0.2, **more),
            vi.SoftStop(0.7 * x, 30.0 / time**2, damping=0.1, side="left", **more),
        )

    def rates(self, t, x, u, P, w):
        push = jnp.cos(0.9 * t + self.phase) - x - 0.1 * u + 0.2 * (P - 100)
        return u, push, 0.5 * (x - (P - 100)), 0.2 * (x * x - w)


class Heater(_InUnits):
    """A switch with hysteresis in a room of varying temperature."""

    names, begins, value, bounds = ("T", "room", "sum"), (300.0, 285.0, 0.0), 1.7, (1.5, 1.9)
    length, modes = 1.0, {"on": 0.0}

    @property
    def events(self):
        def turned(sign, to):
            def guard(m, t, z, on):
                return sign * (z.T / m.scales[0] - 295) - m.p

            return vi.Reset(guard, modes=lambda *_: to)

        return ordered(self.is_flipped, turned(-1, 1.0), turned(1, 0.0))

    def rates(self, t, T, room, total, on):
        varies = 285 + 3 * jnp.cos(2 * jnp.pi * t + self.phase) - room
        return 25 * on - 2 * (T - room), 0.5 * varies, on - total


class Belted(_InUnits):
    """A body on a belt. Cycles end with its turns."""

    names, begins, value, bounds = ("x", "u", "w"), (1.2, 0.2, 0.0), 0.6, (0.3, 2.5)
    cycle = vi.rising("u", usual=lambda m: 6.3 * m.time)

    @property
    def contacts(self):
        speed = self.scales[1]
        level = lambda v: speed * (0.5 + 0.5 * jnp.exp(-2 * v / speed)) / self.time
        return vi.DryFriction(level, slip=lambda z: z.u - self.p * speed, on="u")

    def rates(self, t, x, u, w):
        return u, -x - 0.1 * u, 0.4 * (x - w)


class Valve(_InUnits):
    """A body that excites itself strikes a stop; with a pressure."""

    names, begins, value, bounds = ("x", "u", "P"), (0.2, 0.0, 100.0), 0.8, (0.3, 1.2)
    cycle = vi.rising("u", usual=lambda m: 6.3 * m.time)

    @property
    def contacts(self):
        return vi.RigidStop(self.p * self.scales[0], 0.8, on=("x", "u"))

    def rates(self, t, x, u, P):
        return u, 0.5 * u * (1 - x * x) - x + 0.2 * (P - 100), 0.7 * (x - (P - 100))


class Sliding(_InUnits):
    """A surface along which the state slides, and impacts that are resets with wear."""

    names, begins, value, bounds = ("x", "u", "w"), (0.5, 0.3, 0.0), 0.5, (0.2, 0.9)
    length = 2 * np.pi / 0.5

    @property
    def events(self):
        def surface(m, t, z):
            return z.u / m.scales[1] + 0.2 * z.x / m.scales[0]

        def worn(m, t, z, *_):
            return {"u": -0.7 * z.u, "w": z.w + 0.1 * m.scales[2] * z.u / m.scales[1]}

        strikes = vi.Reset(lambda m, t, z, *_: z.x / m.scales[0] - 0.6, worn)
        return ordered(self.is_flipped, vi.Switch(surface, slides=True), strikes)

    def rates(self, t, x, u, w, side):
        push = 1.2 * jnp.cos(0.5 * t + self.phase) - x - self.p * side - 0.1 * u
        return u, push, -0.3 * w


class _Linked(_Numbers, vi.Mechanical):
    """Two bodies, each coordinate in a unit of its own."""

    q = ("a", "b")
    names: ClassVar[tuple[str, ...]] = q
    inertia: ClassVar[Any]

    def start(self):
        return self.at(**{n: self.scales[i] * self.begins[i] for i, n in enumerate(self.q)})

    def mass(self, q):
        return jnp.asarray(self.inertia) / jnp.outer(self.scales, self.scales)

    def force(self, t, q, v):
        found = self.forces(t / self.time, *self.numbers(q, v))
        return {n: found[i] / self.scales[i] / self.time**2 for i, n in enumerate(self.q)}

    def numbers(self, q, v):
        return [x * unit / self.scales[i] for part, unit in ((q, 1.0), (v, self.time))
                for i, x in enumerate(getattr(part, n) for n in self.q)]  # fmt: skip

    def row(self, state):
        return np.stack(self.numbers(state, state.v))


class Pair(_Linked):
    """Two bodies with a spring and a full mass matrix, each with a stop."""

    inertia, begins, value, bounds = ((1.0, 0.2), (0.2, 2.0)), (0.1, 0.0), 0.5, (0.3, 0.75)
    length = 2 * np.pi / 0.7

    @property
    def contacts(self):
        a, b = self.scales
        left = vi.RigidStop(0.55 * b, 0.5, "left", on="b")
        return ordered(self.is_flipped, vi.RigidStop(self.p * a, 0.7, on="a"), left)

    def forces(self, t, a, b, va, vb):
        spring = 0.3 * (a - b)
        push = jnp.cos(0.7 * t + self.phase) - a - 0.1 * va
        return push - spring, spring - b - 0.1 * vb - 0.3


class Colliding(_Linked):
    """Two bodies that strike each other, one with dry friction."""

    inertia, begins, value, bounds = ((1.0, 0.0), (0.0, 1.5)), (0.1, 0.5), 0.3, (0.1, 0.6)
    length = 2 * np.pi / 0.9

    @property
    def contacts(self):
        a, b = self.scales
        between = vi.RigidStop(self.p, 0.6, on=lambda q: q.a / a - q.b / b)
        return ordered(self.is_flipped, between, vi.DryFriction(0.1 / b / self.time**2, on="b"))

    def forces(self, t, a, b, va, vb):
        return jnp.cos(0.9 * t + self.phase) - a - 0.1 * va, -1.3 * b - 0.2 * vb


class Cranked(_Linked):
    """A motor's crank shakes a body against a stop. Cycles are turns of an angle, in radians."""

    q = names = ("phi", "y")
    value, bounds, linked = 0.9, (0.6, 1.1), ((1,),)
    cycle = vi.turn_of("phi", usual=lambda m: 0.45 * m.time)

    @property
    def contacts(self):
        return vi.RigidStop(0.08 * self.scales[1], 0.5, on="y")

    def mass(self, q):
        return 0.06 + 0.2 * (0.04 * jnp.sin(q.phi)) ** 2, 0.35 / self.scales[1] ** 2

    def forces(self, t, phi, y, speed, v):
        spring = 88.8 * (y - 0.04 * jnp.cos(phi))
        torque = 10.0 * (self.p - speed / 15.93)
        return torque - 0.04 * spring * jnp.sin(phi), -spring - 0.5 * v

    def start(self):
        return self.at(v={"phi": 14.0 / self.time})


MACHINES = (Struck, Rubbed, Cushioned, Heater, Belted, Valve, Sliding, Pair, Colliding, Cranked)


def machine_of(kind, scales=None, phase=0.0, *, is_flipped=False, p=None, time=1.0):
    scales = np.ones(len(kind.names)) if scales is None else scales
    if kind is Cushioned:  # the velocity is the rate of the position
        scales = scales / np.array([1.0, time, 1.0, 1.0])
    numbers = scales, kind.value if p is None else p, phase, time
    return kind(*(jnp.asarray(x, float) for x in numbers), is_flipped=is_flipped)


def units_of(kind):
    """Return scales of the components and of time, 1e-6 or 1e6, so few that each is large while
    each other one is small in one of them: no set of the large ones contains that of another."""
    number = len(kind.names)
    alone = [(i,) for i in range(number) if all(i not in x for x in kind.linked)]
    units = [*kind.linked, *(() if kind is Cranked else alone), "time"]
    count = next(n for n in itertools.count() if math.comb(n, n // 2) >= len(units))
    large = dict(zip(units, itertools.combinations(range(count), count // 2), strict=False))
    for row in range(count):
        size = {unit: FACTORS[row in rows] for unit, rows in large.items()}
        of = {i: size[unit] for unit in units[:-1] for i in unit}
        yield np.array([of.get(i, 1.0) for i in range(number)]), size["time"]


def in_units(kind) -> Iterator[Any]:
    """Yield a machine in its first units, then in others of the components and of time."""
    yield machine_of(kind)
    yield from (machine_of(kind, scales, time=time) for scales, time in units_of(kind))


def variants(kind) -> Iterator[Any]:
    """Yield a machine in several units, and if it is driven with another section."""
    yield from in_units(kind)
    if kind.length is not None:
        yield machine_of(kind, phase=0.37)
