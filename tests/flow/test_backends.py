"""The loop as vector code and by XLA: the same motion to rounding, impact by impact."""

import warnings
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.machine.base import AbstractMachine

from chain import Chain, balls
from differences import quick, some
from rough_block import Block, on_plane

IDEAL = vi.Oscillator(0.05)
ONE, TWO = (vi.RigidStop(1.3, 0.6),), (vi.RigidStop(1.3, 0.6), vi.RigidStop(1.5, 0.4, "left"))
PRESSED = (vi.RigidStop(0.3, 0.4),)


def ideal(ratio, stops=ONE):
    return vi.Scene(oscillator=IDEAL, drive=vi.IdealDrive(ratio), stops=stops)


def motor(kappa):
    return vi.Parameters(torque=10.0, restitution=0.5, gap=0.05, control=kappa).scene()


class Ball(AbstractMachine):
    """Falls by 1 on a stop at 1, over and over; an impact ends a cycle, long before `cycle`."""

    restitution: Any

    @property
    def cycle(self):
        return 6.0

    @property
    def stops(self):
        return (vi.RigidStop(1.0, self.restitution, ends_cycle=True),)

    def field(self, s, state):
        return vi.OscillatorState(state.V, jnp.ones_like(state.Y))

    def start(self, Y, V):
        return vi.OscillatorState(jnp.asarray(Y), jnp.asarray(V))


# Scene of a lane's number, method, options of `simulate`.
CASES = {
    "cycles that an impact ends": (
        lambda r: Ball(0.6 * r),
        vi.Adaptive(),
        {"record": "sections", "rests": False},
    ),
    "exact flight": (ideal, vi.ExactFlight(), {}),
    "exact flight, two stops": (lambda r: ideal(r, TWO), vi.ExactFlight(), {"impact_log": 4}),
    "exact flight, rest": (lambda r: ideal(0.4 * r, PRESSED), vi.ExactFlight(), {}),
    "fixed steps, time": (ideal, vi.FixedStep(), {"clock": "time"}),
    "adaptive steps": (ideal, vi.Adaptive(diffrax.Tsit5(), rtol=1e-9), {"samples": 4}),
    "motor": (motor, vi.FixedStep(), {}),
    "motor, time": (motor, vi.Adaptive(rtol=1e-10), {"clock": "time"}),
    "motor, series": (motor, vi.Taylor(12, 8), {}),
}


@pytest.mark.parametrize(
    "name", quick(CASES, "cycles that an impact ends", slow=("motor", "exact flight, rest"))
)
def test_roads_agree(name):
    make, method, options = CASES[name]

    def lane(ratio):
        scene = make(ratio)
        return vi.simulate(scene, scene.start(Y=0.1, V=0.2), 12, method=method, **options)

    ratios = jnp.linspace(0.7, 1.3, 11)
    runs = []
    for backend in ("auto", "xla"):
        with vi.backend(backend):
            runs.append(jax.jit(jax.vmap(lane))(ratios))
    fast, slow = runs
    assert bool(jnp.all(fast.successful))
    np.testing.assert_array_equal(fast.impacts, slow.impacts)
    # Rounding sizes the steps of an adaptive method, and of the thousand aims of a chatter it may
    # ask for one more.
    if not isinstance(method, vi.Adaptive):
        np.testing.assert_allclose(fast.steps, slow.steps, rtol=2e-3 if "rest" in name else 0)
    if name == "cycles that an impact ends":  # each at k times the speed of the one before
        first = np.sqrt(0.2**2 + 2 * 0.9)
        fall = first * np.outer(0.6 * ratios, np.ones(12)).cumprod(axis=1)
        np.testing.assert_allclose(fast.sections.V[:, 1:], -fall, rtol=1e-9)
    # Rounding grows with the motion, by a factor of 1e3 at most in these lanes; where it sizes the
    # steps, results differ as the tolerance allows.
    close = 1e-9 if isinstance(method, vi.Adaptive) else 1e-12
    for a, b in zip(jax.tree.leaves(fast), jax.tree.leaves(slow), strict=True):
        if a.dtype == jnp.float64:
            np.testing.assert_allclose(a, b, rtol=0, atol=close)


def falling(k):
    """Three balls that touch, dropped on a floor."""
    return Chain(k, (1.0, 2.0, 1.0), 0.0, force=1.0, length=2.0), balls(
        (-0.6, -0.5, -0.4), (0,) * 3
    )


def sliding(pull):
    """A block that falls on a rough floor, and is pulled along it."""
    return Block(0.3, 0.5, pull=pull), on_plane(0, 0.02, 1, 0)


@pytest.mark.exhaustive
@pytest.mark.parametrize("make", [falling, sliding])
def test_roads_agree_where_contacts_act_together(make):
    method = vi.FixedStep(steps_per_cycle=24)
    numbers = jnp.linspace(0.1, 0.7, 5)
    runs = []
    for backend in ("auto", "xla"):
        with vi.backend(backend):
            lane = jax.vmap(lambda x: vi.simulate(*make(x), 3, method=method, impact_log=60))
            runs.append(jax.jit(lane)(numbers))
    fast, slow = runs
    assert bool(fast.successful.all())
    np.testing.assert_array_equal(fast.impacts, slow.impacts)
    np.testing.assert_array_equal(fast.impact_log.stop, slow.impact_log.stop)
    for a, b in zip(jax.tree.leaves(fast.sections), jax.tree.leaves(slow.sections), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", some(CASES, "exact flight", "motor"))
def test_groups_of_any_width_give_the_same(name):
    """Few lanes go in narrow groups and many in wide ones: the same to the last bit."""
    make, method, options = CASES[name]

    @jax.jit
    @jax.vmap
    def lanes(ratio):
        scene = make(ratio)
        return vi.simulate(scene, scene.start(Y=0.1, V=0.2), 12, method=method, **options)

    many = 4 * 16 * vi.lanes.cores() + 3
    ratios = jnp.linspace(0.7, 1.3, many)
    whole = lanes(ratios)
    assert bool(jnp.all(whole.successful))
    for few in (1, 3, 14):
        chosen = np.random.default_rng(few).choice(many, few)
        part = lanes(ratios[chosen])
        for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(part), strict=True):
            np.testing.assert_array_equal(np.asarray(a)[chosen], b)


@pytest.mark.slow
def test_single_precision():
    """In its own measure."""

    def lane(ratio):
        scene = vi.Scene.ideal(frequency_ratio=ratio, restitution=0.6, gap=1.3, damping_ratio=0.05)
        return vi.simulate(scene, scene.start(Y=0.1, V=0.2), 12, method=vi.ExactFlight()).sections.Y

    runs = []
    with jax.enable_x64(False), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for backend in ("auto", "xla"):
            with vi.backend(backend):
                runs.append(jax.jit(jax.vmap(lane))(jnp.linspace(0.7, 1.3, 33)))
    assert runs[0].dtype == jnp.float32
    np.testing.assert_allclose(*runs, atol=2e-5)


class Place(NamedTuple):
    """A body with two more numbers beside it."""

    Y: Any
    V: Any
    memory: Any


class Odd(AbstractMachine):
    """A stop and a field of many kinds of functions, with a 3-vector in its state."""

    stiffness: Any
    table: Any = None
    stops: tuple = (vi.RigidStop(0.2, 0.7),)

    @property
    def cycle(self):
        return 2.0

    def placed(self, state, Y, V):
        return state._replace(Y=Y, V=V)

    def field(self, s, state):
        pull = jnp.where(state.Y > 0, state.Y, jnp.tanh(2 * state.Y)) + jnp.abs(state.Y) ** 1.5
        push = jax.lax.cond(s > 1.0, lambda s: jnp.exp(-s), lambda s: 0.3 * jnp.cos(3 * s), s)
        if self.table is not None:
            push = push + jnp.interp(s, jnp.linspace(0, 2, 5), self.table)
        relaxed = jnp.array([[-1.0, 0.2, 0.0], [0.1, -2.0, 0.0], [0.0, 0.3, -0.5]]) @ state.memory
        return Place(
            state.V, push - self.stiffness * pull - 0.1 * state.V + 0.1 * jnp.sum(state.memory),
            relaxed + state.Y,
        )  # fmt: skip


TABLE = jnp.array([0.0, 0.4, -0.2, 0.1, 0.0])


@pytest.mark.slow
@pytest.mark.parametrize("table", [None, pytest.param(TABLE, marks=pytest.mark.exhaustive)])
def test_a_scene_of_ones_own(table):
    """On the fast backend, or told why not; right on either."""
    start = Place(jnp.asarray(0.1), jnp.asarray(0.5), jnp.zeros(3))

    def lane(stiffness):
        run = vi.simulate(Odd(stiffness, table), start, 6, method=vi.FixedStep())
        return run.last, run.impacts

    values = jnp.linspace(1.0, 4.0, 9)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        fast = jax.jit(jax.vmap(lane))(values)
    if table is None:
        assert not warned
    with vi.backend("xla"):
        slow = jax.jit(jax.vmap(lane))(values)
    for a, b in zip(jax.tree.leaves(fast), jax.tree.leaves(slow), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)
    assert int(jnp.max(fast[1])) > 0
