"""Taylor series: rules compared with derivatives by JAX, and the method with `ExactFlight`."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.flow._step.roots import rising_root, slope
from vi_jax.flow.methods.taylor import Along, expand

from differences import quick

RULES = {
    "arithmetic": lambda t, x: 2 * x - x * t + (x + 1) / (2 + t * t) - x / 3,
    "powers": lambda t, x: x**2 + 0.1 * x**3 + (1 + x) ** -2 + jnp.square(t) + x**4 / 7 + x**5 / 9,
    "roots": lambda t, x: jnp.sqrt(1 + x * x) + jax.lax.rsqrt(2 + x) + (1.5 + x) ** 1.5,
    "exponential": lambda t, x: jnp.exp(-x) + jnp.log2(2 + x * t) + jax.nn.sigmoid(x),
    "circle": lambda t, x: jnp.sin(3 * x) * jnp.cos(t + x),
    "saturation": lambda t, x: jnp.tanh(2 * x) + jnp.abs(jnp.asarray(-3.0)) * x,
    "choice": lambda t, x: jnp.where(jnp.asarray(1.0) > 0, x * x, -x) + jnp.maximum(0.2, 0.1) * x,
    "arrays": lambda t, x: jnp.sum(
        jnp.array([[1.0, 2.0], [0.5, -1.0]]) @ jnp.stack([x * x, t]) * jnp.arange(1.0, 3.0)
    ),
    "one by one": lambda t, x: sum(n * y * y for n, y in enumerate(jnp.stack([x, t, x * t]))),
}


@pytest.mark.parametrize(
    "name", quick(RULES, "saturation", "arrays", "one by one", slow=("powers", "circle"))
)
def test_a_rule_gives_the_derivatives(name):
    """Compare n! c_n with derivatives of the solution from repeated forward mode."""
    field, order = RULES[name], 6
    t0, x0 = jnp.asarray(0.3), jnp.asarray(0.7)
    _, (found,) = expand(field, t0, x0, order)
    rate, factor = field, 1.0
    np.testing.assert_allclose(found[0], x0)
    for n in range(1, order + 1):
        factor *= n
        np.testing.assert_allclose(factor * (found[n] or 0.0), rate(t0, x0), rtol=1e-11, atol=1e-12)
        rate = lambda t, x, f=rate: jax.jvp(f, (t, x), (jnp.ones_like(t), field(t, x)))[1]


def last(scene, start, method):
    return vi.simulate(scene, start, 20, method=method)


@pytest.mark.slow
def test_ideal_drive_matches_exact_flight():
    """Partial, zero and full restitution, and rest."""

    def lane(restitution, gap, method):
        scene = vi.Scene.ideal(
            frequency_ratio=0.8, damping_ratio=0.1, restitution=restitution, gap=gap
        )
        return last(scene, scene.start(Y=-0.5, V=0.4), method)

    numbers = jnp.array([0.5, 0.0, 1.0, 0.3]), jnp.array([1.6, 1.2, 1.1, -0.3])
    mine, truth = (
        jax.vmap(lambda k, gap, m=m: lane(k, gap, m))(*numbers)
        for m in (vi.Taylor(20, 12), vi.ExactFlight())
    )
    assert bool(mine.successful.all()) and int(mine.rests.sum()) > 0
    np.testing.assert_array_equal(mine.impacts, truth.impacts)
    np.testing.assert_array_equal(mine.rests, truth.rests)
    for a, b in (
        (mine.sections.Y, truth.sections.Y), (mine.sections.V, truth.sections.V),
        (mine.y_max, truth.y_max), (mine.y_min, truth.y_min),
    ):  # fmt: skip
        np.testing.assert_allclose(a, b, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("method", [vi.Taylor(16, 8), vi.Taylor(16, rtol=1e-12)])
def test_motor_matches_the_reference(method):
    scene = vi.Parameters(torque=10.0, restitution=0.5, gap=0.08, control=0.9).scene()
    start = scene.start(W=0.9)
    mine = last(scene, start, method)
    truth = last(scene, start, "reference")
    np.testing.assert_array_equal(mine.impacts, truth.impacts)
    for a, b in zip(mine.sections.__dict__.values(), truth.sections.__dict__.values(), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-9)
    np.testing.assert_allclose(mine.impact_speed, truth.impact_speed, atol=2e-9)
    np.testing.assert_allclose(mine.duration, truth.duration, atol=2e-9)


class Wave(vi.AbstractMachine):
    """x' = 1 + cos 12πs: at s = 0 every other term of the series vanishes."""

    cycle: float = 1.0

    def field(self, s, x):
        return 1 + jnp.cos(12 * np.pi * s)


@pytest.mark.parametrize("order", [16, 17])
def test_vanishing_last_term_does_not_imply_a_small_error(order):
    run = vi.simulate(Wave(), jnp.zeros(()), 1, method=vi.Taylor(order, rtol=1e-12))
    np.testing.assert_allclose(run.last, 1.0, rtol=0, atol=1e-11)


def test_function_without_recursion_raises_with_its_name():
    class Odd(vi.CosineCrank):
        def slide(self, phase):
            slide = super().slide(phase)
            return slide._replace(U=slide.U + 0 * jax.scipy.special.erf(phase))

    scene = vi.Scene.ideal(frequency_ratio=0.9, crank=Odd())
    with pytest.raises(NotImplementedError, match="`erf`"):
        vi.simulate(scene, scene.start(), 2, method=vi.Taylor())


class Pushed(vi.AbstractMachine):
    """A body under a force that depends on s and Y."""

    force: Callable
    contacts: tuple = ()
    cycle: float = 1.0

    def field(self, s, state):
        return vi.OscillatorState(state.V, self.force(s, state.Y))


KINKS = {
    "where": lambda s, y: jnp.where(y > 0.2, -1.0, 0.0),
    "maximum": lambda s, y: jnp.maximum(y, 0.2),
    "minimum": lambda s, y: jnp.minimum(y, 0.4),
    "abs": lambda s, y: jnp.abs(y),
    "floor": lambda s, y: jnp.floor(3 * y),
    "sign": lambda s, y: jnp.sign(y),
    "an index": lambda s, y: jnp.arange(3.0).at[jnp.int32(2 * y)].get(wrap_negative_indices=False),
}


@pytest.mark.parametrize("name", KINKS)
def test_nonsmooth_function_raises_with_its_name(name):
    start = vi.OscillatorState(jnp.asarray(0.1), jnp.asarray(1.0))
    with pytest.raises(NotImplementedError, match=f"decides by `{name}` .*`Adaptive`, or a `Swit"):
        vi.simulate(Pushed(KINKS[name]), start, 1, method=vi.Taylor())


class Damped(Pushed):
    def field(self, s, state):
        return vi.OscillatorState(state.V, self.force(s, state.Y, state.V))


def test_strong_damping_shortens_steps():
    """Compare x'' + a x' + x = cos s from (0, 1) with its sum of sin s/a and two exponentials."""

    def end(a):
        force = lambda s, y, v: jnp.cos(s) - y - a * v
        machine = Damped(force, (vi.RigidStop(0.9, 0.5),), 2 * np.pi)
        return vi.simulate(machine, vi.OscillatorState(0.0 * a, 1.0 + 0 * a), 1, method=vi.Taylor())

    a = np.array([3.0, 10.0, 30.0, 1000.0])
    run, root = jax.vmap(end)(jnp.asarray(a)), np.sqrt(a * a - 4)
    free = (1 - 1 / a) / root * np.exp(np.pi * (root - a))
    assert bool(run.successful.all()) and int(run.impacts.sum()) == 0
    np.testing.assert_allclose(run.last.Y, free, rtol=0, atol=1e-6)


def test_rounding_at_release_is_not_a_turning_point():
    """v = -4e-33 - 1e-17 t + t²/2 - 10 t³ is zero at 1/20, and at 2e-17 by rounding at s = 2."""
    series = [jnp.asarray(x) for x in (0.0, -4e-33, -5e-18, 1 / 6, -2.5)]

    def turn(path):
        facing = tuple(-x for x in slope(path.over(jnp.asarray(0.1))))
        return 0.1 * float(rising_root(facing, iterations=8))

    assert turn(Along(series)) < 1e-15
    assert abs(turn(Along(series).without_rounding_after_release(jnp.asarray(4e-14))) - 0.05) < 1e-9
    moving = [*series[:2], jnp.asarray(-1e-3), *series[3:]]
    assert turn(Along(moving).without_rounding_after_release(jnp.asarray(4e-14))) == turn(
        Along(moving)
    )


@pytest.mark.parametrize(
    "options", [dict(order=3), dict(steps_per_cycle=4), dict(rtol=0.0), dict(rtol=float("nan"))]
)
def test_invalid_arguments_raise(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        vi.Taylor(**options)
