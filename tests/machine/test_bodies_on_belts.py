"""Bodies with several frictions: on a belt of varying speed, and on each other. Reference numbers
are those of SciPy, followed from event to event (DOP853, rtol 1e-12)."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

pytestmark = pytest.mark.slow


class Belt(vi.Mechanical):
    """A body held on a belt by static friction, and one that slides on it."""

    q = ("a", "b")
    mass = (1.0, 0.8)
    w: Any = 1.0
    level: Any = 0.5
    between: Any = 0.3
    ratio: Any = 1.3
    size: Any = 0.2
    drift: Any = 0.0
    drive: Any = 0.4

    @property
    def cycle(self):
        return 2 * jnp.pi / self.w

    def speed(self, t):
        k, sizes = np.arange(1, 6), np.array([1.0, 0.4, 0.3, 0.2, 0.1])
        phases = np.array([0.0, np.pi / 2, 1.0, np.pi / 2, 0.0])
        return self.drift + self.size * jnp.sum(sizes * jnp.sin(k * self.w * t + phases))

    @property
    def contacts(self):
        slip = lambda t, z: z.v.a - self.speed(t)
        return (
            vi.DryFriction(self.level, slip=slip, on="a", static_ratio=self.ratio),
            vi.DryFriction(self.between, on=lambda q: q.b - q.a),
        )

    def force(self, t, q, v):
        return dict(a=-q.a, b=self.drive * jnp.cos(2 * self.w * t) - 0.6 * q.b)


def ends(kind, given, cycles, method="standard", **start):
    """Return the last positions of many machines, and whether all motions succeeded."""
    places, good = each_end(kind, given, cycles, method, **start)
    return places, bool(good.all())


def each_end(kind, given, cycles, method="standard", **start):
    """Return the last position of many machines, and whether each motion succeeded."""

    def last(given):
        machine = kind(**given)
        run = vi.simulate(machine, machine.at(**start), cycles, method=method)
        return jnp.stack([getattr(run.last, x) for x in machine.q]), run.successful

    return map(np.asarray, jax.jit(jax.vmap(last))(jax.tree.map(jnp.asarray, given)))


@pytest.mark.parametrize("method", ["standard", vi.FixedStep(steps_per_cycle=150)])
def test_static_friction_lets_go_on_a_belt(method):
    draw, n = np.random.default_rng(0).uniform, 4000
    ranges = dict(
        w=(0.4, 1.5), level=(0.1, 1), between=(0.1, 0.8), ratio=(1.05, 1.5), size=(0.1, 0.6),
        drift=(-0.3, 0.3), drive=(0.2, 1.0),
    )  # fmt: skip
    lanes = [461, 1941, 1452, 3, 17]
    given = {name: draw(*x, n)[lanes] for name, x in ranges.items()}
    found, good = ends(Belt, given, 3, method, a=0.2, b=0.3)
    expected = [
        (-0.753954023666, -13.859165684306), (-0.581680568486, -1.604025587437),
        (-1.033317703839, -0.965803380918), (-0.623220619603, 4.886438817765),
        (-0.152515143621, -0.592102703939),
    ]  # fmt: skip
    assert good
    np.testing.assert_allclose(found, expected, atol=2e-8)


class Three(vi.Mechanical):
    """A body on a belt, one on it or beside it, and one on the ground; two may strike each other,
    or a stop."""

    q = ("a", "b", "c")
    w: Any
    levels: Any
    ratios: Any
    belt: Any
    drive: Any
    gap: Any
    restitution: Any
    kind: str = eqx.field(static=True, default="three")

    mass = (1.0, 0.8, 1.3)

    @property
    def cycle(self):
        return 2 * jnp.pi / self.w

    def speed(self, t):
        size, drift, *phases = self.belt
        k, sizes = np.arange(1, 6), np.array([1.0, 0.4, 0.3, 0.2, 0.1])
        return drift + size * jnp.sum(sizes * jnp.sin(k * self.w * t + jnp.stack(phases)))

    @property
    def contacts(self):
        slip, names = (lambda t, z: z.v.a - self.speed(t)), ("a", lambda q: q.b - q.a, "c")
        rubs = [
            vi.DryFriction(self.levels[i], on=on, static_ratio=self.ratios[i], **more)
            for i, (on, more) in enumerate(zip(names, ({"slip": slip}, {}, {}), strict=True))
        ]
        stop = vi.RigidStop(self.gap, self.restitution, on="b")
        strikes = vi.RigidStop(self.gap, self.restitution, on=lambda q: q.c - q.b)
        return {
            "three": rubs, "stop": (*rubs, stop), "two": (*rubs[:2], stop),
            "bodies": (rubs[0], rubs[2], strikes),
        }[self.kind]  # fmt: skip

    def force(self, t, q, v):
        drive = self.drive * jnp.cos(2 * self.w * t)
        left, right = 0.8 * (q.a - q.b), 0.5 * (q.b - q.c)
        return dict(a=-q.a - left, b=left - right + drive - 0.2 * q.b, c=right - 0.6 * q.c)


class Coupled(Three):
    """The same with a full mass matrix."""

    off: Any = None

    def mass(self, q):
        o = self.off
        return [[1.0, o[0], o[1]], [o[0], 0.8, o[2]], [o[1], o[2], 1.3]]


def drawn(seed, n):
    """Return the numbers of random machines `Coupled`."""
    draw = np.random.default_rng(seed).uniform
    off = draw(-0.15, 0.15, (n, 3))
    given = dict(
        w=draw(0.4, 1.5, n), levels=draw(0.05, 0.9, (n, 3)), ratios=draw(1.0, 1.5, (n, 3)),
    )  # fmt: skip
    size, drift = draw(0.05, 0.5, n), draw(-0.3, 0.3, n)
    given |= dict(
        drive=draw(0.2, 1.2, n), gap=draw(0.15, 0.6, n), restitution=draw(0.2, 0.9, n), off=off
    )
    given["belt"] = np.column_stack([size, drift, draw(0, 2 * np.pi, (n, 5))])
    return given


@pytest.mark.parametrize("kind", ["stop", "bodies", "full mass matrix"])
def test_static_ratios_and_impacts_on_belts(kind):
    """Regressions: frictions that began to slip at one instant and held each other again ended
    lanes; so did a body that slides between the impacts of a chatter. At an impact, a body that was
    not struck left its belt, by the method's error of its slip: places were wrong by up to 0.1."""
    draw, n = np.random.default_rng(0).uniform, 96
    phases = draw(0, 2 * np.pi, (n, 5))
    given = dict(
        w=draw(0.4, 1.5, n), levels=draw(0.05, 0.9, (n, 3)), ratios=draw(1.0, 1.5, (n, 3)),
        belt=np.column_stack([draw(0.05, 0.5, n), draw(-0.3, 0.3, n), phases]),
        drive=draw(0.2, 1.2, n), gap=draw(0.15, 0.6, n), restitution=draw(0.2, 0.9, n),
    )  # fmt: skip
    machine = functools.partial(Three, kind=kind)
    if kind == "full mass matrix":
        machine, given = Coupled, drawn(0, n)
    start = dict(a=0.1, b=0.1, c=0.05, v=dict(a=0.2))
    found, good = ends(machine, given, 1, **start)
    finer, fine = ends(machine, given, 1, vi.FixedStep(steps_per_cycle=150), **start)
    assert good and fine
    np.testing.assert_allclose(found, finer, rtol=0, atol=1e-8)


@pytest.mark.filterwarnings("ignore:vi_jax is running in single precision")
@pytest.mark.parametrize("kind", [Belt, Coupled])
def test_single_precision(kind):
    """Regression: of 96 belts 8 were lost, and of three bodies 11. Guards counted as jumped by
    rounding, and small forces of friction as ties. One was off by 3e-3: an event was accepted far
    from its place. One belt is still lost: rounding turns a body that sticks, or the body that
    begins to slip sticks again."""
    draw, n, start = np.random.default_rng(5).uniform, 96, dict(a=0.1, b=0.1, c=0.05, v=dict(a=0.2))
    given, cycles = drawn(0, n), 1
    if kind is Belt:
        start, cycles = dict(a=0.2, b=0.3), 3
        ranges = dict(
            w=(0.4, 1.5), level=(0.1, 1), between=(0.1, 0.8), ratio=(1, 1.5), size=(0.1, 0.6),
            drift=(-0.3, 0.3), drive=(0.2, 1.0),
        )  # fmt: skip
        given = {name: draw(*x, n) for name, x in ranges.items()}
    expected, all_good = ends(kind, given, cycles, **start)
    assert all_good
    with jax.enable_x64(False):
        found, good = each_end(kind, given, cycles, **start)
    assert np.sum(~good) <= 1
    np.testing.assert_allclose(found[good], expected[good], rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    ("machine", "kind", "drawn_by", "lane", "expected"),
    [
        (Coupled, "stop", (1, 512), 19, (0.228985331207, 0.162989054632, 0.047471110098)),
        (Coupled, "two", (1, 512), 240, (0.272481035319, -0.040766497928, -1.571574527273)),
        (Three, "stop", (104, 256), 113, (0.428385234804, 0.163328311077, 0.05)),
    ],
)
def test_a_body_that_rests_while_others_stick_or_slip(machine, kind, drawn_by, lane, expected):
    """Regressions: at rest the sign of a velocity of 1e-13 was taken for the direction of motion.
    After the release, a turn was sought where none is. A body on the belt let go of it when another
    came to rest: speeds before its last impacts and after them were compared at one time (the
    numbers are those of 400 fixed steps, in which it did not)."""
    given = {name: x[[lane]] for name, x in drawn(*drawn_by).items()}
    if machine is Three:
        del given["off"]
    start = dict(a=0.1, b=0.1, c=0.05, v=dict(a=0.2))
    found, good = ends(functools.partial(machine, kind=kind), given, 3, **start)
    assert good
    np.testing.assert_allclose(found[0], expected, rtol=0, atol=2e-9)


class Averaged(Coupled):
    def averages(self, t, z):
        return dict(power=z.v.a * z.v.b, place=z.b, square=z.c**2 + z.a**2)


def numbers_of(given, moved):
    """Return all numbers of a run with derivatives, and the kinds and names of its events."""
    w, drive, *levels, gap, restitution = moved
    given = given | dict(w=w, drive=drive, gap=gap, restitution=restitution)
    machine = Averaged(**given | dict(levels=jnp.stack([*levels, given["levels"][2]])), kind="stop")
    start = machine.at(a=0.1, b=0.1, c=0.05, v=dict(a=0.2))
    run = vi.simulate(
        machine, start, 1, method=vi.FixedStep(steps_per_cycle=60), event_log=24, impact_log=24
    )
    log, impacts = run.event_log, run.impact_log
    numbers = (
        log.phase, run.averages, run.impact_energy, run.y_max, run.y_min, run.duration, run.last,
        impacts.phase, impacts.speed, impacts.impulse,
    )  # fmt: skip
    found = jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves(numbers)])
    return jnp.nan_to_num(found), (log.kind, log.number, run.successful)


def test_derivatives_of_logs_averages_and_energies():
    """Each entry, along a direction of six parameters, forward beside Richardson differences, and a
    sum of all in reverse."""
    n, h = 8, 1e-4
    given = jax.tree.map(jnp.asarray, drawn(7, n))
    moved = [given[x] for x in ("w", "drive")], given["levels"].T[:2], [given["gap"]]
    moved = jnp.stack([*moved[0], *moved[1], *moved[2], given["restitution"]], 1)
    directions = 0.1 * np.random.default_rng(3).normal(size=moved.shape)

    def derivatives(given, p, d):
        at = functools.partial(numbers_of, given)
        value, forward = jax.jvp(lambda p: at(p)[0], (p,), (d,))
        weights = jnp.sin(1.0 + jnp.arange(value.size))
        reverse = jax.grad(lambda p: weights @ at(p)[0])(p) @ d
        return forward, reverse, weights @ forward, *jax.vmap(lambda t: at(p + t * d))(steps)

    steps = jnp.array([h, -h, 0.5 * h, -0.5 * h])
    forward, reverse, total, values, (kinds, numbers, good) = jax.tree.map(
        np.asarray, jax.jit(jax.vmap(derivatives))(given, moved, directions)
    )
    alike = lambda x: (x == x[:, :1]).reshape(n, -1).all(1)
    comparable = good.all(1) & alike(kinds) & alike(numbers)
    assert comparable.sum() >= 6
    coarse, fine = (values[:, i] - values[:, i + 1] for i in (0, 2))
    expected = (4 * fine / h - coarse / (2 * h)) / 3
    off = np.abs(forward - expected) / (1 + np.abs(expected))
    assert off[comparable].max() < 1e-6
    np.testing.assert_allclose(reverse, total, rtol=1e-10, atol=1e-10)
