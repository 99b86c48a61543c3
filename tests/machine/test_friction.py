"""Dry friction with sticking, compared with Den Hartog and closed forms."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.flow import EventKind

from den_hartog import den_hartog


def on_a_belt(machine):
    """Return friction on a floor that moves at the machine's `speed`, in the phase clock."""
    return vi.DryFriction(
        machine.level, static_ratio=machine.ratio, on="V", mass=machine.frequency,
        slip=lambda x: x.V - machine.speed,
    )  # fmt: skip


class Rubbing(vi.AbstractMachine):
    """x'' + x = A cos ωt - friction, in the phase clock."""

    amplitude: jax.Array
    frequency: jax.Array
    level: jax.Array
    ratio: jax.Array
    speed: jax.Array = eqx.field(default=0.0, converter=jnp.asarray)

    @property
    def contacts(self):
        return on_a_belt(self)

    cycle = 2 * np.pi

    def field(self, s, x):
        push = self.amplitude * jnp.cos(s) - x.Y
        return vi.OscillatorState(x.V / self.frequency, push / self.frequency)

    def step_limit(self, s, x):
        return 0.4 * np.pi * jnp.minimum(1.0, self.frequency)


def at_rest(Y):
    return vi.OscillatorState(jnp.asarray(Y), jnp.zeros(()))


def stops_in_a_cycle(V):
    """Count the stops of a periodic motion from its velocity at samples."""
    stands = np.asarray(V)[1:] == 0
    return int((stands & ~np.roll(stands, 1)).sum())


def test_amplitudes_match_den_hartog():
    ratios, shares = (0.6, 0.75, 0.9, 1.2, 1.6, 2.5), (0.3, 0.7, 0.97, 1.05, 1.2)
    cases = [(r, share, share * den_hartog(r, 0.0)[1]) for r in ratios for share in shares]

    def settled(r, _, level):
        options = {"settle": 400, "samples": 400, "method": vi.Adaptive(rtol=1e-11)}
        return vi.simulate(Rubbing(1.0, r, level, 1.0), at_rest(0.1), 1, **options)

    run = vi.jit(jax.vmap(settled))(*map(jnp.asarray, zip(*cases, strict=True)))
    assert bool(run.successful.all())
    for i, (r, share, level) in enumerate(cases):
        stops = stops_in_a_cycle(run.samples.state.V[i])
        if share < 1:
            amplitude = den_hartog(r, level)[0]
            np.testing.assert_allclose(run.y_max[i, 0], amplitude, atol=1e-9)
            np.testing.assert_allclose(run.y_min[i, 0], -amplitude, atol=1e-9)
            assert stops == 0
        else:
            assert stops >= 2 and stops % 2 == 0
        if r > 0.7 and share > 1:
            assert stops == 2


class OnABelt(vi.AbstractMachine):
    """A body on a spring and on a moving belt. A cycle ends where it rises through x = level."""

    speed: jax.Array
    level: jax.Array
    ratio: jax.Array
    frequency: float = 1.0

    @property
    def contacts(self):
        return on_a_belt(self)

    cycle = vi.rising(lambda m, z: z.Y - m.level, usual=2 * np.pi)

    def field(self, s, x):
        return vi.OscillatorState(x.V, -x.Y)


@pytest.mark.parametrize(
    "method", [vi.Adaptive(rtol=1e-12), vi.FixedStep(steps_per_cycle=64), vi.Taylor()], ids="aft"
)
def test_a_body_on_a_belt(method):
    """The body sticks until the spring pulls it off, and slides until it is as fast as the belt."""
    v, f, ratio = 0.3, 0.5, 1.6
    start = vi.OscillatorState(*map(jnp.asarray, (0.0, v)))
    run = vi.simulate(OnABelt(*map(jnp.asarray, (v, f, ratio))), start, 6, method=method)
    drop = f * (ratio - 1)
    period = 2 * drop / v + 2 * (np.pi - np.arctan(drop / v))
    np.testing.assert_allclose(run.duration[1:], period, atol=1e-8)
    np.testing.assert_allclose(run.y_max[1:], f + np.hypot(drop, v), atol=1e-8)
    np.testing.assert_allclose(run.sections.V[1:], v, atol=1e-14)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [({"level": -0.1}, "`level`"), ({"level": float("nan")}, "`level`"),
     ({"static_ratio": 0.9}, "`static_ratio`")],
)  # fmt: skip
def test_wrong_arguments_raise(arguments, told):
    with pytest.raises(ValueError, match=told):
        vi.DryFriction(**{"level": 1.0, **arguments}, on="V")


class Shaken(vi.AbstractMachine):
    """A body on a surface whose speed depends on time and on the component w."""

    surface: Any = eqx.field(static=True)
    cycle: Any = 1.0

    @property
    def contacts(self):
        return vi.DryFriction(0.1, on="v", mass=1.0, slip=lambda t, z: z.v - self.surface(t, z.w))

    def field(self, t, z):
        return {"x": z.v, "v": 0.0 * z.v, "w": 0.0}

    def renewed(self, z):
        return z.replace(w=-z.w)


@pytest.mark.slow
def test_surfaces_whose_speed_jumps():
    """Friction is 0.1 and never holds the body, even where the speed of the surface jumps."""
    start = vi.State(x=0.0, v=0.0, w=1.0)
    run = vi.simulate(Shaken(lambda t, w: w), start, 3, samples=2)
    assert run.samples.state.v == pytest.approx(np.array([0, 1, 2, 1, 0, 1, 2]) / 20, abs=1e-15)
    run = vi.simulate(Shaken(lambda t, w: 2 * t - 1), start, 2)
    assert float(run.sections.v[1]) == pytest.approx(0.1 - 2 / 21, abs=1e-12)  # turns at t = 10/21
    with pytest.raises(ValueError, match=r"jumps by 2 at t = 0\.5\. Let it jump where"):
        vi.simulate(Shaken(lambda t, w: jnp.where(t < 0.5, 1.0, -1.0)), start, 1)
    with pytest.warns(UserWarning, match="within a thousandth of a cycle, at t = 0.5:"):
        vi.simulate(Shaken(lambda t, w: jnp.tanh(1e4 * (t - 0.5))), start, 1)


def test_a_turn_where_friction_reverses_counts_for_the_stop_ahead_only():
    """The far wall is not reached, so the clearance is its distance from the smallest position.
    Without it there is no other turn before a stop. Regression: turns away from a stop counted."""

    class Rubbed(vi.AbstractMachine):
        cycle = 2 * np.pi
        wall: float | None = None

        @property
        def contacts(self):
            stops = [vi.RigidStop(0.1, 0.6, on=("x", "u")), vi.DryFriction(0.1, on="u")]
            if self.wall is not None:
                stops.append(vi.RigidStop(self.wall, 0.6, "left", on=("x", "u")))
            return tuple(stops)

        def field(self, t, z):
            return dict(x=z.u, u=jnp.cos(t) - 0.5 * z.x)

    start = vi.State(x=0.0, u=0.0)
    alone, between = (
        vi.simulate(Rubbed(wall), start, 4, settle=40, impact_log=8) for wall in (None, 9.0)
    )
    assert int(alone.impacts.min()) > 0 and float(alone.y_min.min()) < -0.2
    np.testing.assert_allclose(between.clearance, 9.0 + between.y_min, atol=1e-9)
    assert bool((alone.clearance == jnp.inf).all())


class Carried(vi.Mechanical):
    """A body on a belt, one on another, and one pressed onto a stop: all stick."""

    q = ("x", "a", "b", "c", "d")
    mass = (1.0, 2.0, 3.0, 1.0, 1.0)
    cycle = 4.0
    belt: float = 0.5

    @property
    def contacts(self):
        return (
            vi.DryFriction(1.0, on="x", slip=lambda z: z.v.x - self.belt),
            vi.DryFriction(1.0, on=lambda q: q.b - q.a),
            vi.RigidStop(0.0, 0.4, "left", on="c", friction=0.8, along="d"),
        )

    def force(self, t, q, v):
        push = 0.3 * jnp.sin(jnp.pi * t / 2)
        return dict(x=0.0, a=push, b=0.0, c=-1.0, d=push)


@pytest.mark.slow
def test_derivatives_from_a_start_that_sticks():
    """A small slip stops at once: the belt keeps its speed, and the two bodies their momentum."""

    def last(numbers):
        belt, x, a, b, d = numbers
        machine = Carried(belt=belt)
        run = vi.simulate(machine, machine.at(v=dict(x=x, a=a, b=b, d=d)), 1)
        return jnp.stack([run.last.x, run.last.a, run.last.b, run.last.d])

    numbers = jnp.array([0.5, 0.5, 0.2, 0.2, 0.0])
    together = [0, 0, 4 * 2 / 5, 4 * 3 / 5, 0]
    truth = [[4.0, 0, 0, 0, 0], together, together, [0.0] * 5]
    np.testing.assert_allclose(jax.jacfwd(last)(numbers), truth, atol=1e-9)


class OnSurface(vi.AbstractMachine):
    """The speed slides along the surface u = c."""

    c: float = 0.0
    cycle = 2 * np.pi
    events = vi.Switch(lambda m, t, z: z.u - m.c, slides=True)

    def field(self, t, z, side):
        return dict(x=z.u, u=0.3 * jnp.sin(t) - 0.1 * z.x - side)


def test_derivatives_from_a_start_that_slides_along_a_surface():
    last = lambda u, c: vi.simulate(OnSurface(c=c), vi.State(x=0.2, u=u), 1).last.x
    found = jax.grad(last, (0, 1))(0.0, 0.0)
    np.testing.assert_allclose(found, [0.0, 2 * np.pi], atol=1e-9)


class Rubbed(vi.AbstractMachine):
    """A body with dry frictions whose levels and static ratios are given."""

    amplitude: Any = 1.0
    levels: Any = (0.4,)
    ratios: Any = (1.375,)
    cycle = 2 * jnp.pi / 0.3

    @property
    def contacts(self):
        given = zip(self.levels, self.ratios, strict=True)
        return tuple(vi.DryFriction(x, on="u", static_ratio=r) for x, r in given)

    def field(self, t, z):
        return dict(x=z.u, u=self.amplitude * jnp.cos(0.3 * t) - z.x)


def test_frictions_on_one_velocity_add():
    """Levels 0.1 and 0.3 equal one of 0.4; the largest forces at rest add, too."""

    def ends(levels, ratios):
        def last(amplitude):
            machine = Rubbed(amplitude, levels, ratios)
            return vi.simulate(machine, vi.State(x=0.1, u=0.0), 2).last

        return jax.tree.leaves(jax.vmap(last)(jnp.array([0.3, 0.6, 1.0])))

    one, two = ends((0.4,), (1.375,)), ends((0.1, 0.3), (1.0, 1.5))
    np.testing.assert_allclose(one, two, rtol=0, atol=1e-10)  # events: to rounding
    assert np.std(one[0]) > 0.1

    class Opposite(Rubbed):
        contacts = (
            vi.DryFriction(0.1, on="u"),
            vi.DryFriction(0.3, slip=lambda z: -z.u, push={"u": -1.0}),
        )

    with pytest.raises(ValueError, match=r"a Opposite must have .* 0 and 1 are mult"):
        vi.simulate(Opposite(), vi.State(x=0.1, u=0.0), 1)


class Clutches(vi.Mechanical):
    """Three bodies, each rubbing on the next: the first pair from t = 0.4 on, the second without
    load."""

    q = ("b", "c", "d")
    mass = (1.0, 1.0, 1.0)
    cycle = 1.0
    contacts = (
        vi.DryFriction(
            0.5, on=lambda q: q.c - q.b, load=lambda t, z: jnp.where(t < 0.4, 0.0, 20.0)
        ),
        vi.DryFriction(0.5, on=lambda q: q.d - q.c, load=lambda t, z: 0.0 * t),
    )

    def force(self, t, q, v):
        return dict(b=0.0, c=0.0, d=0.0)


def test_friction_without_load_logs_only_changes():
    """A body of speed 10 is braked by 10, the next one sped up by 10, until both have speed 5."""
    machine = Clutches()
    run = vi.simulate(machine, machine.at(v=dict(b=10.0)), 1, event_log=8)
    log = run.event_log
    np.testing.assert_allclose(log.phase[0, :2], [0.4, 0.9], rtol=0, atol=1e-9)
    assert log.number[0, :3].tolist() == [1, 0, -1]
    assert log.value[0, :2].tolist() == [-1, 0]  # the second slips, the first sticks
    np.testing.assert_allclose([run.last.c, run.last.d], [1.75, 0.0], rtol=0, atol=1e-8)


class Loaded(vi.AbstractMachine):
    """A body that is pulled and rubs: x'' = pull(x) - level(x') load(x)."""

    pull: Callable = eqx.field(static=True)
    load: Callable | None = eqx.field(static=True, default=None)
    level: Any = 1.0
    cycle = 3.0

    @property
    def contacts(self):
        return vi.DryFriction(self.level, on="u", load=self.load)

    def field(self, t, z):
        return dict(x=z.u, u=self.pull(z.x))


def test_a_load_that_becomes_negative_ends_the_lane():
    """A load of 1 - x, or a level that falls with the speed. One that only touches zero ends
    nothing: x'' = x²/2 from x = -1 with the speed √⅓ has x' = √((x³ + 2)/3)."""
    pull, start = lambda x: 1.2, vi.State(x=0.0, u=0.5)
    falling = Loaded(pull, lambda z: 1 - z.x), Loaded(pull, None, lambda v: 1 - v / 2)
    for machine in falling:
        assert vi.simulate(machine, start).result == vi.RESULTS.jammed
    lifted = Loaded(pull, lambda z: jnp.maximum(1 - z.x, 0))
    assert vi.simulate(lifted, start).successful
    touching = Loaded(lambda x: x**2, lambda z: z.x**2, 0.5)
    end = vi.simulate(touching, vi.State(x=-1.0, u=3**-0.5)).last
    np.testing.assert_allclose(end.u, jnp.sqrt((end.x**3 + 2) / 3), rtol=1e-9)
    assert end.x > 0


class Pressed(vi.AbstractMachine):
    """A load that swings slowly presses a body, which friction brakes, on its stop."""

    level: float
    cycle = 4 * np.pi

    @property
    def contacts(self):
        stop = vi.RigidStop(0.3, 0.0, on=("x", "u"))
        return stop, vi.DryFriction(self.level, on="u", mass=1.0)

    def field(self, s, z):
        return {"x": z.u, "u": jnp.sin(0.5 * s) - z.x - 0.1 * z.u}


def test_friction_on_a_stop_does_not_hold_for_ever():
    """Regression: a body that slid into its stop without speed was held by friction there and
    never released. It leaves when the load falls below spring and friction."""
    levels = np.linspace(0.25, 0.6, 60)
    start = vi.State(x=0.3, u=0.0)
    run = jax.vmap(lambda level: vi.simulate(Pressed(level), start, 2, event_log=12))(levels)
    assert bool(run.successful.all())
    kind, phase = (np.asarray(x)[:, 1] for x in (run.event_log.kind, run.event_log.phase))
    released = np.array([p[k == int(EventKind.release)] for p, k in zip(phase, kind, strict=True)])
    leaves = 2 * (np.pi - np.arcsin(0.3 + levels))
    np.testing.assert_allclose(released[:, 0], leaves, rtol=1e-9)
