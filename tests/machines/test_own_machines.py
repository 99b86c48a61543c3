"""Machines of one's own: two bodies that meet, a belt that drags, a block that sticks and slips."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

PI = np.pi


def field(default):
    return eqx.field(kw_only=True, default=default, converter=lambda x: jnp.asarray(x, float))


class TwoBodies(eqx.Module):
    x: Any
    u: Any
    y: Any
    v: Any


class Meeting(vi.AbstractMachine):
    """Two bodies on springs that meet where x - y = gap; the second has a wall at y = wall."""

    omega: Any = field(1.3)
    amplitude: Any = field(1.0)
    mass: Any = field(0.7)
    spring: Any = field(2.0)
    gap: Any = field(0.3)
    wall: Any = field(0.4)
    between: Any = field(0.6)
    outer: Any = field(0.8)

    @property
    def stops(self):
        return (
            vi.RigidStop(self.gap, self.between),
            vi.RigidStop(self.wall, self.outer, coordinate=1),
        )

    @property
    def coordinates(self):
        m = self.mass

        def apart(z, Y, V):
            dx, du = Y - (z.x - z.y), V - (z.u - z.v)
            one, other = m / (1 + m), 1 / (1 + m)
            return TwoBodies(z.x + one * dx, z.u + one * du, z.y - other * dx, z.v - other * du)

        return (
            vi.Coordinate(lambda z: z.x - z.y, lambda z: z.u - z.v, apart, m / (1 + m)),
            vi.Coordinate(
                lambda z: z.y, lambda z: z.v, lambda z, Y, V: TwoBodies(z.x, z.u, Y, V), m
            ),
        )

    def position(self, state):
        return state.x - state.y

    def velocity(self, state):
        return state.u - state.v

    @property
    def cycle(self):
        return 2 * PI / self.omega

    def field(self, s, state):
        z = state
        first = self.amplitude * jnp.cos(self.omega * s) - z.x - 0.1 * z.u
        return TwoBodies(z.u, first, z.v, (-self.spring * z.y - 0.1 * z.v) / self.mass)


class Belt(vi.AbstractMachine):
    """A body on a spring and on a belt that drags it: a self-excited oscillation."""

    speed: Any = field(0.5)
    ratio: Any = field(1.5)
    damping: Any = field(0.0)
    stops: tuple[vi.RigidStop, ...] = ()

    @property
    def cycle(self):
        return 2 * PI

    def section(self, state):
        return -state.V

    @property
    def switches(self):
        return (
            vi.DryFriction(
                1.0,
                static_ratio=self.ratio,
                velocity=lambda belt, x: x.V - belt.speed,
                force=lambda belt, s, x: belt.pull(x),
                stopped=lambda belt, x: vi.OscillatorState(x.Y, belt.speed),
            ),
        )

    def pull(self, state):
        return -state.Y - 2 * self.damping * state.V

    def field(self, s, state, mode):
        pull = self.pull(state)
        return vi.OscillatorState(
            state.V, pull + self.switches[0].contribution(self, s, state, mode)
        )

    def start(self):
        return vi.OscillatorState(jnp.array(0.0), jnp.array(0.0))


class Block(vi.AbstractMachine):
    """A block on a spring and on rough ground, driven; by phase."""

    omega: Any = field(0.4)
    level: Any = field(0.5)
    stops: tuple[vi.RigidStop, ...] = ()

    @property
    def cycle(self):
        return 2 * PI

    def pace(self, s, state):
        return 1 / self.omega

    def step_limit(self, s, state):
        return 0.4 * PI * jnp.minimum(1.0, self.omega)

    def pull(self, s, state):
        return jnp.cos(s) - state.Y - 0.04 * state.V

    @property
    def switches(self):
        return (
            vi.DryFriction(
                self.level,
                velocity=lambda block, x: x.V,
                force=lambda block, s, x: block.pull(s, x),
                stopped=lambda block, x: vi.OscillatorState(x.Y, jnp.zeros_like(x.V)),
            ),
        )

    def field(self, s, state, mode):
        pull = self.pull(s, state)
        rate = pull + self.switches[0].contribution(self, s, state, mode)
        return vi.OscillatorState(state.V / self.omega, rate / self.omega)

    def start(self):
        return vi.OscillatorState(jnp.array(0.0), jnp.array(0.0))


def drawn(number):
    draw = np.random.default_rng(7).uniform
    names = ("amplitude", "omega", "mass", "spring", "gap", "wall", "between", "outer")
    low = (0.2, 0.3, 0.2, 0.5, 0.05, 0.05, 0.3, 0.3)
    high = (2.0, 2.5, 4.0, 4.0, 1.0, 1.0, 1.0, 1.0)
    numbers = {
        name: jnp.asarray(draw(a, b, number)) for name, a, b in zip(names, low, high, strict=True)
    }
    state = draw(-0.5, 0.0, number), draw(-1, 1, number), draw(-0.5, 0.04, number)
    start = TwoBodies(*map(jnp.asarray, (*state, draw(-1, 1, number))))
    y = jnp.maximum(start.y, start.x - numbers["gap"] + 1e-3)
    return numbers, eqx.tree_at(lambda z: z.y, start, jnp.minimum(y, numbers["wall"]))


def met(method, record, number=250):
    def one(numbers, start):
        return vi.simulate(Meeting(**numbers), start, 5, method=method, record=record)

    return vi.jit(jax.vmap(one))(*drawn(number))


class Tanks(NamedTuple):
    """A state of any names; the field is linear, x' = cos s - rate·x and y' = x - 2y."""

    level: Any
    heat: Any


class Filter(vi.AbstractMachine):
    rate: jax.Array
    stops = ()

    @property
    def cycle(self):
        return 2 * np.pi

    def field(self, s, state):
        x, y = state
        return Tanks(jnp.cos(s) - self.rate * x, x - 2 * y)

    def start(self):
        return Tanks(jnp.asarray(0.3), jnp.asarray(0.1))


@pytest.mark.slow
def test_a_machine_without_stops_needs_no_position():
    """It runs with every verb, and its extremes are those of the first number of its state."""
    machine = Filter(jnp.asarray(1.0))
    orbit = vi.find_orbit(machine, machine.start())
    run = vi.simulate(machine, orbit.state, 1)
    x = 1 / (1j + 1)
    wanted = x.real, (x / (1j + 2)).real
    for state in (orbit.state, run.last):
        np.testing.assert_allclose(state, wanted, atol=1e-9)
    assert float(run.y_max[0]) == pytest.approx(abs(x), abs=1e-8)
    np.testing.assert_allclose(orbit.multipliers, np.exp([-2 * np.pi, -4 * np.pi]), atol=1e-9)
    branch = vi.continue_orbit(orbit, parameter="rate", bounds=(0.5, 2.0))
    np.testing.assert_allclose(branch.y_max, 1 / np.abs(1j + branch.parameter), atol=1e-9)
    with pytest.raises(TypeError, match="`start` must hold real numbers, but got 'none'"):
        vi.simulate(machine, "none", 1)


def test_two_bodies_at_rest_on_one_another():
    """Held, they go on together: neither the rounding of their distance nor the force that either
    would feel alone ends the motion."""
    run = met(vi.FixedStep(steps_per_cycle=100), "motion")
    assert int((~run.successful).sum()) <= 4, "both contacts chatter at once"
    assert int(jnp.sum(run.rests > 0)) > 15
    failed = run.result != vi.RESULTS.successful
    chatters = run.result == vi.RESULTS.chatter
    assert bool((~failed | chatters).all())


@pytest.mark.slow
def test_no_turn_hides_that_of_another_coordinate():
    truth = met(vi.FixedStep(steps_per_cycle=200), "motion")
    run = met(vi.Taylor(20, rtol=1e-12), "sections")
    never = (jnp.sum(truth.rests, axis=1) == 0) & truth.successful
    assert int(never.sum()) > 200
    np.testing.assert_array_equal(run.impacts[never], truth.impacts[never])
    np.testing.assert_allclose(run.last.x[never], truth.last.x[never], atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("record", ["motion", "sections"])
def test_a_belt_beside_its_closed_form(record):
    """It sticks for 2c/v and slips for 2π - 2 atan(c/v), c being what sticking holds above slip;
    a step may end where the body turns."""
    c, v = 0.5, 0.5
    for method in (vi.Adaptive(rtol=1e-12), vi.Taylor(20, rtol=1e-12), vi.Taylor(20, 16)):
        run = vi.simulate(Belt(), Belt().start(), 20, method=method, record=record)
        assert bool(run.successful)
        assert float(run.last.Y) == pytest.approx(1 + np.hypot(c, v), abs=1e-10)
        if record == "motion":
            lasts = 2 * PI - 2 * np.arctan2(c, v) + 2 * c / v
            assert float(run.duration[-1]) == pytest.approx(lasts, abs=1e-9)


@pytest.mark.slow
def test_the_branch_of_a_belt_ends_where_slip_no_longer_reaches_it():
    belt = Belt()
    orbit = vi.find_orbit(belt, vi.simulate(belt, belt.start(), 20).last)
    np.testing.assert_allclose(orbit.multipliers, 0, atol=1e-9)
    branch = vi.continue_orbit(orbit, parameter="damping", bounds=(0.0, 1.0))
    # SciPy: the damping at which the greatest velocity of slip is the belt's.
    assert branch.special[-1].parameter == pytest.approx(0.05782911613766, abs=1e-10)
    with pytest.raises(ValueError, match="no `observed_every`"):
        vi.lyapunov(belt, belt.start())


@pytest.mark.slow
def test_a_block_is_followed_while_it_sticks():
    """The beginning of a slip, with velocity and acceleration zero, is no touch."""
    block = Block()
    orbit = vi.find_orbit(block, vi.simulate(block, block.start(), 1, settle=60).last)
    branch = vi.continue_orbit(orbit, parameter="omega", bounds=(0.2, 2.0))
    assert branch.ends[0] == "bounds"
    assert branch.parameter.min() == pytest.approx(0.2)
    (change,) = branch.special
    assert change.kind == "crossing-sliding" and "passes its surface there at once" in change.detail
    # Where it comes to a stop the force is what friction just holds.
    where = change.orbit
    run = vi.simulate(where.machine, where.state, 1, method=vi.Adaptive(rtol=1e-11), samples=2048)
    s, Y, V = 2 * PI * run.samples.cycles, run.samples.state.Y, run.samples.state.V
    still = np.argmin(np.abs(np.asarray(V)))
    assert abs(float(np.cos(s[still]) - Y[still])) == pytest.approx(0.5, abs=0.02)
    with pytest.raises(ValueError, match="beyond passes its surface there"):
        vi.boundary(change, parameter="level", bounds=((0.2, 2.0), (0.1, 0.9)))


@pytest.mark.slow
def test_a_stop_of_another_coordinate_does_not_limit_the_first():
    pair = Meeting(gap=5.0, wall=0.05, amplitude=0.3)
    orbit = vi.find_orbit(pair, TwoBodies(*map(jnp.asarray, (0.2, 0.0, 0.0, 0.0))))
    assert bool(orbit.successful) and float(orbit.y_max) > 0.2
    assert bool(orbit.admissible)
