"""Dry friction with sticking: Den Hartog's closed form, a belt's, SciPy, energy, derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp

from den_hartog import den_hartog
from differences import check_derivatives

CLOSE = vi.Adaptive(rtol=1e-12)


class Books(eqx.Module):
    """A body, and what has been done to it."""

    Y: jax.Array
    V: jax.Array
    work: jax.Array
    heat: jax.Array


def on_a_belt(machine):
    """Friction of a machine that has a `pull`, on a floor that moves at its `speed`."""
    return vi.DryFriction(
        machine.level,
        static_ratio=machine.ratio,
        velocity=lambda machine, x: x.V - machine.speed,
        force=lambda machine, s, x: machine.pull(s, x),
        stopped=lambda machine, x: eqx.tree_at(lambda x: x.V, x, machine.speed),
    )


class Rubbing(vi.AbstractMachine):
    """x'' + x = A cos ωt - friction; by phase."""

    amplitude: jax.Array
    frequency: jax.Array
    level: jax.Array
    ratio: jax.Array
    speed: jax.Array = eqx.field(default=0.0, converter=jnp.asarray)
    stops: tuple = ()

    @property
    def switches(self):
        return (on_a_belt(self),)

    @property
    def cycle(self):
        return 2 * np.pi

    def pull(self, s, x):
        return self.amplitude * jnp.cos(s) - x.Y

    def field(self, s, x, mode):
        pull = self.pull(s, x)
        rub = self.switches[0].contribution(self, s, x, mode)
        slides = jnp.where(mode == 0, 0.0, self.level * mode)
        rates = Books(x.V, pull + rub, self.amplitude * jnp.cos(s) * x.V, slides * x.V)
        return jax.tree.map(lambda rate: rate / self.frequency, rates)

    def step_limit(self, s, x):
        return 0.4 * np.pi * jnp.minimum(1.0, self.frequency)


def rubbing(numbers, Y, cycles, **options):
    zero = jnp.zeros_like(Y)
    return vi.simulate(Rubbing(*numbers), Books(Y, zero, zero, zero), cycles, **options)


def stops_in_a_cycle(V):
    """How often a body comes to stand in a periodic motion, from its velocity at samples."""
    stands = np.asarray(V)[1:] == 0
    return int((stands & ~np.roll(stands, 1)).sum())


@pytest.mark.parametrize("r", [0.6, 0.75, 0.9, 1.2, 1.6, 2.5])
def test_den_hartog(r):
    limit = den_hartog(r, 0.0)[1]
    shares = jnp.asarray([0.3, 0.7, 0.97, 1.05, 1.2])

    def settled(share):
        numbers = 1.0, r, share * limit, 1.0
        return rubbing(tuple(map(jnp.asarray, numbers)), jnp.asarray(0.1), 1, settle=400,
                       samples=400, method=vi.Adaptive(rtol=1e-11))  # fmt: skip

    run = vi.jit(jax.vmap(settled))(shares)
    assert bool(run.successful.all())
    for i, share in enumerate(np.asarray(shares)):
        stops = stops_in_a_cycle(run.samples.state.V[i])
        if share < 1:
            amplitude = den_hartog(r, share * limit)[0]
            np.testing.assert_allclose(run.y_max[i, 0], amplitude, atol=1e-9)
            np.testing.assert_allclose(run.y_min[i, 0], -amplitude, atol=1e-9)
            assert stops == 0
        else:
            assert stops >= 2 and stops % 2 == 0
        if r > 0.7 and share > 1:
            assert stops == 2


@pytest.mark.slow
def test_friction_that_holds_everything():
    held = rubbing((0.5, 0.7, 0.6, 1.0), jnp.asarray(0.05), 3, samples=20)
    np.testing.assert_array_equal(held.samples.state.Y, 0.05)
    assert bool(held.successful)
    # More of it while it sticks than while it slides: off it goes at another force.
    moved = rubbing((0.5, 0.7, 0.3, 1.5), jnp.asarray(0.0), 1, samples=200)
    still = rubbing((0.5, 0.7, 0.3, 1.7), jnp.asarray(0.0), 1, samples=200)
    assert float(moved.y_max[0]) > 0.01 and float(still.y_max[0]) == 0


def integrated(A, w, f, ratio, Y0, duration):
    """The body after a while and how often its friction changed, by SciPy's DOP853."""

    def pull(t, x):
        return A * np.cos(w * t) - x[0]

    def rate(t, x):
        return [0.0, 0.0] if mode == 0 else [x[1], pull(t, x) - mode * f]

    def change(t, x):
        return abs(pull(t, x)) - f * ratio if mode == 0 else -mode * x[1]

    change.terminal, change.direction = True, 1

    def set_off(t, x):
        return 0 if abs(pull(t, x)) <= f * ratio else np.sign(pull(t, x))

    t, x, changes = 0.0, np.array([Y0, 0.0]), 0
    mode = set_off(t, x)
    while t < duration - 1e-14:
        found = solve_ivp(
            rate, (t, duration), x, method="DOP853", rtol=1e-13, atol=1e-14, events=change,
            max_step=0.05,
        )  # fmt: skip
        t, x = found.t[-1], found.y[:, -1].copy()
        if found.status == 1:
            changes += 1
            if mode == 0:
                mode = np.sign(pull(t, x))
            else:
                x[1], mode = 0.0, set_off(t, x)
    return x, changes


def drawn(number):
    draw = np.random.default_rng(0).uniform
    numbers = np.stack([draw(0.5, 2, number), draw(0.2, 1.8, number), draw(0.05, 0.8, number),
                        draw(1, 1.5, number)])  # fmt: skip
    return numbers, draw(-1, 1, number)


@pytest.mark.slow
def test_sticking_and_sliding_beside_scipy():
    numbers, starts = drawn(40)
    runs = [
        vi.jit(jax.vmap(lambda p, y, m=m: rubbing(tuple(p), y, 8, method=m), in_axes=(1, 0)))(
            jnp.asarray(numbers), jnp.asarray(starts)
        )
        for m in (CLOSE, vi.FixedStep(steps_per_cycle=48), vi.Taylor(20, 16))
    ]
    assert all(bool(run.successful.all()) for run in runs)
    several = 0
    for i in range(40):
        wanted, changes = integrated(*numbers[:, i], starts[i], 16 * np.pi / numbers[1, i])
        for run, allowed in zip(runs, (1e-8, 1e-7, 1e-8), strict=True):
            found = [run.last.Y[i], run.last.V[i]]
            np.testing.assert_allclose(found, wanted, atol=allowed)
        several += changes
    assert several > 500
    last = runs[0].last
    energy = 0.5 * (last.Y**2 + last.V**2) - 0.5 * starts**2
    np.testing.assert_allclose(energy, last.work - last.heat, atol=1e-9)
    assert (np.diff(runs[0].sections.heat, axis=1) >= 0).all()


class OnABelt(vi.AbstractMachine):
    """A body on a spring, on a belt that moves on; a cycle ends where it comes along x = level."""

    speed: jax.Array
    level: jax.Array
    ratio: jax.Array
    stops: tuple = ()

    @property
    def switches(self):
        return (on_a_belt(self),)

    @property
    def cycle(self):
        return 2 * np.pi

    def section(self, state):
        return state.Y - self.level

    def pull(self, s, x):
        return -x.Y

    def field(self, s, x, mode):
        zero, pull = jnp.zeros_like(s), self.pull(s, x)
        return Books(x.V, pull + self.switches[0].contribution(self, s, x, mode), zero, zero)


@pytest.mark.parametrize("method", [CLOSE, vi.FixedStep(steps_per_cycle=64), vi.Taylor()],
                         ids="aft")  # fmt: skip
def test_a_body_on_a_belt(method):
    """It sticks until the spring pulls it off, and slides until it is as fast as the belt again."""
    v, f, ratio = 0.3, 0.5, 1.6
    start = Books(*map(jnp.asarray, (0.0, v, 0.0, 0.0)))
    run = vi.simulate(OnABelt(*map(jnp.asarray, (v, f, ratio))), start, 6, method=method)
    drop = f * (ratio - 1)
    period = 2 * drop / v + 2 * (np.pi - np.arctan(drop / v))
    np.testing.assert_allclose(run.duration[1:], period, atol=1e-8)
    np.testing.assert_allclose(run.y_max[1:], f + np.hypot(drop, v), atol=1e-8)
    np.testing.assert_allclose(run.sections.V[1:], v, atol=1e-14)


@pytest.mark.slow
def test_derivatives_through_sticking():
    numbers, starts = drawn(40)

    def last(x):
        run = rubbing(tuple(x[:4]), x[4], 3, method=vi.FixedStep(steps_per_cycle=48))
        return run.last, run.impacts

    at = [*numbers[:, 0], starts[0]]
    check_derivatives(last, at, step=1e-6, impacts=0)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [({"level": -0.1}, "`level`"), ({"level": float("nan")}, "`level`"),
     ({"static_ratio": 0.9}, "`static_ratio`")],
)  # fmt: skip
def test_wrong_numbers_are_named(arguments, told):
    with pytest.raises(ValueError, match=told):
        vi.DryFriction(
            **{"level": 1.0, **arguments},
            velocity=lambda machine, x: x.V,
            force=lambda machine, s, x: -x.Y,
            stopped=lambda machine, x: x,
        )
