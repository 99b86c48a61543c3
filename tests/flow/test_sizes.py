"""What counts as rounding: of a guard far from zero, of a slip beside numbers in other units."""

import warnings
from contextlib import nullcontext as nothing
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.flow.sizes import row_sizes, sizes_of

from planar import Block


class Thermostat(vi.AbstractMachine):
    """A furnace that is switched on and off at the ends of a narrow band around 295 K."""

    band: float
    length: float

    modes: ClassVar = {"on": 0.0}
    events = (
        vi.Reset(lambda m, t, z, on: 295 - m.band / 2 - z.T, modes=lambda *_: 1.0),
        vi.Reset(lambda m, t, z, on: z.T - 295 - m.band / 2, modes=lambda *_: 0.0),
    )

    @property
    def cycle(self):
        return self.length

    def field(self, t, z, on):
        return dict(T=25 * on - 2 * (z.T - 285))


@pytest.mark.parametrize(
    ("double", "band", "error"), [(True, 3e-6, 1e-12), (True, 1e-7, 1e-12), (False, 0.05, 1e-4)]
)
def test_guards_with_a_threshold_far_from_zero_arm(double, band, error):
    low, high = 295 - band / 2, 295 + band / 2
    first = 0.5 * np.log(10 / (low - 285))
    up, down = (
        0.5 * np.log((297.5 - low) / (297.5 - high)),
        0.5 * np.log((high - 285) / (low - 285)),
    )
    expected = np.cumsum([first, up, down, up, down])
    with jax.enable_x64(double), pytest.warns(UserWarning) if not double else nothing():
        machine = Thermostat(band, 1.1 * expected[-1])
        run = vi.simulate(machine, vi.State(T=295.0), 1, event_log=6)
        assert bool(run.successful)
        np.testing.assert_array_equal(run.event_log.number[0], [0, 1, 0, 1, 0, -1])
        np.testing.assert_allclose(run.event_log.phase[0, :5], expected, rtol=0, atol=error)


class Hydraulic(vi.AbstractMachine):
    """A body that slides against dry friction, with a pressure that acts on nothing."""

    cycle = 1.0

    @property
    def contacts(self):
        return vi.DryFriction(1.0, on="u", static_ratio=2.0)

    def field(self, t, z):
        return dict(x=z.u, u=1.5 + 0.0 * z.x, p=0.0 * z.p)


@pytest.mark.parametrize(("double", "slip"), [(True, 1e-8), (False, 0.02)])
def test_a_slip_does_not_depend_on_numbers_in_other_units(double, slip):
    for pressure in (0.0, 1e5, 2e7):
        with jax.enable_x64(double), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            run = vi.simulate(Hydraulic(), vi.State(x=0.0, u=slip, p=pressure), 1)
            assert bool(run.successful)
            np.testing.assert_allclose(run.last.x, slip + 0.25, rtol=1e-6)


class Harmonics(vi.AbstractMachine):
    """A given motion of four harmonics, which enters a stop for a short part of a short cycle."""

    size: Any
    phase: Any
    gap: Any

    cycle = 2 * np.pi / 500

    @property
    def contacts(self):
        return vi.RigidStop(self.gap, 0.5, on=("x", "u"))

    def motion(self, t):
        return motion(500.0 * t, self.size, self.phase)

    def field(self, t, z):
        rate = lambda t: jax.jvp(self.motion, (t,), (jnp.ones_like(t),))[1]
        return dict(x=z.u, u=jax.jvp(rate, (t,), (jnp.ones_like(t),))[1])

    def at(self):
        x, u = jax.jvp(self.motion, (jnp.zeros(()),), (jnp.ones(()),))
        return vi.State(x=x, u=u)


class Same(Harmonics):
    """The same with its cycle as a number of the machine."""

    length: Any = 2 * np.pi / 500

    @property
    def cycle(self):
        return self.length


WEIGHTS = np.array([0.3, 0.3, 1.0, 1.0])


def motion(angle, size, phase):
    harmonics = jnp.arange(1, 5)
    return jnp.sum(size * jnp.cos(harmonics * angle + phase))


def test_brief_impacts_of_a_short_cycle_are_not_missed():
    rng = np.random.default_rng(5)
    size, phase = rng.uniform(0.2, 1, (800, 4)) * WEIGHTS, rng.uniform(0, 2 * np.pi, (800, 4))
    angles = np.linspace(0, 2 * np.pi, 8001)[:, None]
    waves = size[:, None] * np.cos(np.arange(1, 5) * angles + phase[:, None])
    x = waves.sum(axis=-1)
    depth = 10 ** rng.uniform(-6, -2, 800)
    gap = x.max(axis=1) - depth
    inside = x[:, 0] < gap
    for kind in (Harmonics, Same):

        def impacts(size, phase, gap, kind=kind):
            machine = kind(size, phase, gap)
            return vi.simulate(machine, machine.at(), 1, method="draft").impacts[0]

        found = jax.jit(jax.vmap(impacts))(size, phase, gap)
        assert np.count_nonzero((found == 0) & inside) <= 2


class Turned(vi.Mechanical):
    """A body that shakes, and does not turn."""

    q = ("x", "tilt")
    mass = (1.0, 1.0)
    cycle = 2 * np.pi

    def force(self, t, q, v):
        return dict(x=jnp.cos(t) - q.x, tilt=0.0 * q.x)


def test_rounding_of_a_number_at_rest_is_not_its_size():
    """Regression: a body that came to stand, with an angle of 1e-17, could not go on."""
    machine, zero = Turned(), jnp.zeros(())
    for tilt, size in ((0.0, 1.0), (1e-17, 1.0), (1e-3, 1e-3)):
        start = jax.tree.map(jnp.asarray, machine.at(x=0.5, tilt=tilt))
        sizes = sizes_of(machine, zero, start, ())
        assert float(sizes.tilt) == size


@pytest.mark.parametrize("creep", [0.0, 1e-12])
def test_friction_gives_a_standing_body_a_size_along_the_floor(creep):
    """Regression: a standing block was unsettled, since its size was that of its rounding."""
    block = Block(mu=0.3)
    start = block.at(x=creep, y=0.5, v=dict(x=creep))
    unit = block.cycle / (2 * np.pi)
    x, v_x = row_sizes(block, start)[np.array([0, 3])]
    # The friction of a corner acts on the mass of that corner, which turns as well.
    lightest = 1 / (1 + 0.5**2 * 3 / (0.2**2 + 0.5**2))
    assert 0.3 * 9.81 * unit * lightest <= v_x * 1.000001 <= 0.3 * 9.81 * unit
    assert float(x) == pytest.approx(unit * float(v_x), rel=0.35)
