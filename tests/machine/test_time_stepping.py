"""Random planar machines with friction on shaken floors, compared with Moreau's time stepping."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from event_by_event import followed
from moreau import impacts, moreau, rows_of
from planar import Block

END, HARMONICS = 0.5, np.arange(1, 6)


def floor(t, sizes, phases, xp=jnp):
    """Return the acceleration of a floor with five harmonics of 2 Hz."""
    return xp.sum(sizes * xp.cos(4 * np.pi * HARMONICS * t + phases), -1)


class ShakenBlock(Block):
    """A block, or a rod if its height is 0, seen from a floor that is shaken in both directions."""

    sizes: Any = None
    phases: Any = None
    cycle: Any = END

    def force(self, t, q, v):
        x, y = (floor(t, self.sizes[i], self.phases[i]) for i in range(2))
        return dict(x=-x, y=-9.81 - y, tilt=0.0)


def simulated(kind, given, q, v, found, cycles=1, max_impacts=4000):
    """Return arrays `found(machine, run)` of each lane, and whether its motion was completed."""

    def one(given, q, v):
        machine = kind(**given)
        place, speeds = (dict(zip(machine.q, x, strict=True)) for x in (q, v))
        start = machine.at(**place, v=speeds)
        run = vi.simulate(machine, start, cycles, max_impacts=max_impacts)
        return *found(machine, run), run.successful

    numbers = jax.tree.map(jnp.asarray, (given, q, v))
    return [np.asarray(x) for x in jax.jit(jax.vmap(one))(*numbers)]


def compared(kind, given, gaps, places, mass, mu, q, v, weights):
    """Return the greatest difference in the positions at the end between each lane and a reference.

    Lanes with a restitution of 1, in which nothing comes to rest, are followed from event to event,
    the others by time stepping, whose steps are halved for lanes that differ by more than 1e-4, 7
    times at most. `gaps` and `places` are functions of the coordinates and `given`, `weights` one
    of two accelerations and `given`.

    Differences of 1e-3 to 8e-2 were those of the reference. It let impacts gain energy, of which
    the package has the share θ that gains none (8 of 120 blocks). Two corners strike within 1e-5,
    and steps of 3e-5 change their order (3 blocks). With restitution 1 no steps were short enough:
    three stacks that differed from 64,000 steps by 4e-4 to 2e-3 agree with SciPy to 6e-10.
    """
    last = lambda machine, run: (jnp.stack([getattr(run.last, x) for x in machine.q]),)
    found, good = simulated(kind, given, q, v, last)
    restitution = np.repeat(given["restitution"][:, None], mu.shape[1], 1)
    given = {**given, "mass": mass, "mu": mu, "restitution": restitution}
    error = np.full(len(q), np.inf)

    def force(t, q, v, given):
        x, y = (-floor(t, given["sizes"][:, i], given["phases"][:, i], np) for i in range(2))
        return weights(x, y - 9.81, given)

    def lane_of(i):
        return {name: x[i] for name, x in given.items()}

    for i in np.flatnonzero(restitution[:, 0] == 1):
        here = slice(i, i + 1)
        end = by_events(gaps, places, force, lane_of(here), q[here], v[here])
        error[i] = np.abs(found[i] - end).max()
    left = np.flatnonzero(restitution[:, 0] < 1)
    for steps in 2_000 * 2 ** np.arange(8):
        end = moreau(gaps, places, force, lane_of(left), q[left], v[left], END, steps)[0]
        error[left] = np.abs(found[left] - end).max(1)
        left = left[~(error[left] <= 1e-4)]
        if not left.size:
            break
    return error, good


def by_events(gaps, places, force, given, q, v):
    """Return the positions at the end of one lane by SciPy, if no contact stays closed."""
    n = q.shape[1]

    def rate(t, x):
        pull = force(t, x[None, :n], x[None, n:], given)
        return np.concatenate([x[n:], (pull / given["mass"])[0]])

    def after(t, x):
        q, v = x[None, :n], x[None, n:]
        gap, rows, gains = rows_of(gaps, places, given, q)
        return np.concatenate([x[:n], impacts(rows, gains, v, gap < 1e-10, given)[0][0]])

    events = [
        (lambda t, x, k=k: -gaps(x[None, :n], given)[k][0], after)
        for k in range(given["mu"].shape[1])
    ]
    return followed(rate, np.concatenate([q[0], v[0]]), END, events, max_step=2e-3)[1][:n]


def shaking(rng, lanes, along, up):
    """Return sizes and phases of five harmonics in both directions."""
    sizes = rng.uniform(0, 1, (lanes, 2, 5)) / HARMONICS
    return sizes * np.array([along, up])[:, None], rng.uniform(0, 2 * np.pi, (lanes, 2, 5))


def random_blocks(rng, lanes):
    sizes, phases = shaking(rng, lanes, 8.0, 5.0)
    a, h = rng.uniform(0.1, 0.4, lanes), rng.uniform(0.1, 0.5, lanes)
    h[::4] = 0.0  # rods
    mu, e = rng.uniform(0, 1, lanes), rng.choice([0.0, 0.3, 0.7, 1.0], lanes)
    given = dict(half_width=a, half_height=h, mu=mu, restitution=e, sizes=sizes, phases=phases)
    tilt = np.where(np.arange(lanes) % 3 > 0, rng.uniform(-0.3, 0.3, lanes), 0.0)
    drop = np.where((np.arange(lanes) % 2 > 0) | (e == 1), rng.uniform(0, 0.1, lanes), 0.0)
    high = a * np.abs(np.sin(tilt)) + h * np.cos(tilt) + drop
    q = np.stack([np.zeros(lanes), high, tilt], 1)
    v = np.stack([rng.uniform(-1, 1, lanes), np.zeros(lanes), np.zeros(lanes)], 1)
    return given, q, v


@pytest.mark.slow
def test_random_blocks_on_a_shaken_floor():
    """Blocks and rods with two corners."""
    lanes = 30
    given, q, v = random_blocks(np.random.default_rng(1), lanes)
    a, h, mu = given["half_width"], given["half_height"], np.repeat(given["mu"][:, None], 2, 1)

    def gaps(q, given):
        a, h = given["half_width"], given["half_height"]
        return [q[:, 1] + b * a * np.sin(q[:, 2]) - h * np.cos(q[:, 2]) for b in (-1, 1)]

    def places(q, given):
        a, h = given["half_width"], given["half_height"]
        return [q[:, 0] + b * a * np.cos(q[:, 2]) + h * np.sin(q[:, 2]) for b in (-1, 1)]

    mass = np.stack([np.ones(lanes), np.ones(lanes), (a * a + h * h) / 3], 1)
    pull = lambda x, y, given: np.stack([x, y, 0 * x], 1)
    error, good = compared(ShakenBlock, given, gaps, places, mass, mu, q, v, pull)
    assert good.all()
    assert (error < np.where(given["restitution"] == 1, 1e-7, 1e-4)).all(), error


@pytest.mark.slow
def test_no_motion_on_a_floor_at_rest_gains_energy():
    given, q, v = random_blocks(np.random.default_rng(2), 120)
    given = {**given, "sizes": 0 * given["sizes"], "cycle": np.full(120, END / 16)}
    energies = lambda machine, run: (jax.vmap(machine.energy)(run.sections),)
    energy, good = simulated(ShakenBlock, given, q, v, energies, 16)
    assert good.all()
    assert (np.diff(energy, axis=1) < 1e-9).all()


class ThreeFeet(ShakenBlock):
    """A block with a third foot below its centre."""

    @property
    def places(self):
        return dict(left=-self.half_width, middle=0.0, right=self.half_width)


@pytest.mark.slow
def test_blocks_on_three_feet_come_to_rest():
    """In 6 of 40 of these the middle foot carried all alone, and the others hopped for ever or were
    released by rounding."""
    given, q, v = random_blocks(np.random.default_rng(3), 40)
    given["restitution"] = np.minimum(given["restitution"], 0.7)
    given["sizes"][::2] = 0.0

    def found(machine, run):
        feet = [stop.on(run.last) for stop in machine.contacts]
        return jax.vmap(machine.energy)(run.sections), jnp.stack(feet)

    energy, feet, good = simulated(ThreeFeet, given, q, v, found, 4)
    assert good.all(), np.flatnonzero(~good)
    assert feet.min() > -1e-9
    assert (np.diff(energy[::2], axis=1) < 1e-9).all()


class Stack(vi.Mechanical):
    """A body on another one on a shaken floor; bodies slide and hop."""

    mass_2: Any = 1.0
    mu: Any = None
    restitution: Any = 0.0
    sizes: Any = None
    phases: Any = None
    cycle: Any = END
    q = ("x", "y", "x_2", "y_2")

    def mass(self, q):  # pyright: ignore[reportIncompatibleVariableOverride]
        return 1.0, 1.0, self.mass_2, self.mass_2

    @property
    def contacts(self):
        above = dict(on=lambda q: q.y_2 - q.y, along=lambda q: q.x_2 - q.x)
        ground = vi.RigidStop(0.0, self.restitution, "left", on="y", friction=self.mu[0], along="x")
        between = vi.RigidStop(0.0, self.restitution, "left", friction=self.mu[1], **above)
        return ground, between

    def force(self, t, q, v):
        x, y = (floor(t, self.sizes[i], self.phases[i]) for i in range(2))
        down, masses = -9.81 - y, self.mass(q)
        return dict(x=-x, y=down, x_2=-masses[2] * x, y_2=masses[2] * down)


@pytest.mark.slow
def test_random_stacks_on_a_shaken_floor():
    lanes, rng = 20, np.random.default_rng(5)
    sizes, phases = shaking(rng, lanes, 8.0, 12.0)
    mass_2, mu = rng.uniform(0.3, 3.0, lanes), rng.uniform(0, 1, (lanes, 2))
    e = rng.choice([0.0, 0.3, 0.7, 1.0], lanes)
    given = dict(mass_2=mass_2, mu=mu, restitution=e, sizes=sizes, phases=phases)
    falls = (rng.integers(0, 2, (lanes, 2)) > 0) | (e == 1)[:, None]
    zero, drop = np.zeros(lanes), rng.uniform(0, 0.05, (lanes, 2)) * falls
    q = np.stack([zero, drop[:, 0], zero, drop.sum(1)], 1)
    v = np.stack([rng.uniform(-1, 1, lanes), zero, rng.uniform(-1, 1, lanes), zero], 1)
    one = np.ones(lanes)
    mass = np.stack([one, one, mass_2, mass_2], 1)
    gaps = lambda q, given: [q[:, 1], q[:, 3] - q[:, 1]]
    places = lambda q, given: [q[:, 0], q[:, 2] - q[:, 0]]
    heavy = lambda x, given: given["mass_2"] * x
    pull = lambda x, y, given: np.stack([x, y, heavy(x, given), heavy(y, given)], 1)
    error, good = compared(Stack, given, gaps, places, mass, mu, q, v, pull)
    assert good.all()
    assert (error < np.where(given["restitution"] == 1, 1e-7, 1e-4)).all(), error


class Boxes(vi.Mechanical):
    """Two boxes that turn, one on the other, seen from a shaken floor. Each has two corners on a
    surface."""

    half_width: Any = None
    half_height: Any = None
    mass_of: Any = None
    mu: Any = None
    restitution: Any = 0.0
    sizes: Any = None
    phases: Any = None
    cycle: Any = END
    q = ("x0", "y0", "t0", "x1", "y1", "t1")

    def mass(self, q):  # pyright: ignore[reportIncompatibleVariableOverride]
        inertia = (self.half_width**2 + self.half_height**2) / 3
        return tuple(self.mass_of[i] * x for i in range(2) for x in (1.0, 1.0, inertia[i]))

    def corner(self, q, i, side):
        """Return the height of a corner above the surface below, and its place along it."""
        x, y, tilt = (getattr(q, f"{name}{i}") for name in "xyt")
        s, c, b, h = jnp.sin(tilt), jnp.cos(tilt), side * self.half_width[i], self.half_height
        x, y = x + b * c + h[i] * s, y + b * s - h[i] * c
        if i == 0:
            return y, x
        s, c, x, y = jnp.sin(q.t0), jnp.cos(q.t0), x - q.x0, y - q.y0
        return c * y - s * x - h[0], c * x + s * y

    @property
    def contacts(self):
        return tuple(
            vi.RigidStop(
                0.0, self.restitution, "left", friction=self.mu[i],
                on=lambda q, i=i, b=b: self.corner(q, i, b)[0],
                along=lambda q, i=i, b=b: self.corner(q, i, b)[1],
            ) for i in range(2) for b in (-1, 1)
        )  # fmt: skip

    def force(self, t, q, v):
        x, y = (floor(t, self.sizes[i], self.phases[i]) for i in range(2))
        pull = (-x, -9.81 - y, 0.0)
        return {f"{name}{i}": self.mass_of[i] * p for i in range(2)
                for name, p in zip("xyt", pull, strict=True)}  # fmt: skip

    def energy(self, z):
        speeds = jnp.stack([getattr(z.v, name) for name in self.q])
        own = 0.5 * jnp.sum(jnp.stack(self.mass(z)) * speeds**2)
        return own + 9.81 * (self.mass_of[0] * z.y0 + self.mass_of[1] * z.y1)


def random_boxes(rng, lanes):
    """Return random stacks: odd ones on a shaken floor, the others dropped on a floor at rest."""
    shaken, draw = np.arange(lanes) % 2 == 1, rng.uniform
    sizes, phases = shaking(rng, lanes, 8.0, 6.0)
    a, h = np.sort(draw(0.1, 0.4, (lanes, 2)), 1)[:, ::-1], draw(0.05, 0.3, (lanes, 2))
    given = dict(half_width=a, half_height=h, mass_of=draw(0.3, 3.0, (lanes, 2)))
    given.update(mu=draw(0.1, 0.8, (lanes, 2)), restitution=draw(0, 0.6, lanes))
    given["restitution"][::5] = 0.0
    given.update(sizes=sizes * shaken[:, None, None], phases=phases)
    dropped = ~shaken | (draw(size=lanes) < 0.5)
    q, v = np.zeros((lanes, 6)), np.zeros((lanes, 6))
    for n in range(lanes):
        base = 0.0
        for i in range(2):
            tilt = draw(-0.1, 0.1) * (dropped[n] and draw() < 0.7)
            drop = draw(0, 0.05) * dropped[n]
            lift = a[n, i] * abs(np.sin(tilt)) + h[n, i] * np.cos(tilt)
            x, y = draw(-0.03, 0.03) * (i > 0), base + lift + drop
            q[n, 3 * i : 3 * i + 3], base = (x, y, tilt), y + lift
        v[n, 0::3] = draw(-1, 1, 2) * dropped[n] * 0.5
    return given, q, v


@pytest.mark.slow
def test_stacks_of_boxes_come_to_rest():
    """Five of these were lost: their numbers are 2 to 6. An impact gave corners that stick a slip
    that vanished within 1e-8 and opened another contact meanwhile, for ever. Bodies that began to
    slip, without acceleration yet, had the error of their sticking as a slip the other way."""
    given, q, v = random_boxes(np.random.default_rng(1), 160)
    some = np.array([20, 24, 22, 55, 59, 87, 95, 53])

    def found(boxes, run):
        corners = [boxes.corner(run.sections, i, b)[0] for i in range(2) for b in (-1, 1)]
        return jax.vmap(boxes.energy)(run.sections), jnp.stack(corners)

    numbers = jax.tree.map(lambda x: x[some], (given, q, v))
    energy, corners, good = simulated(Boxes, *numbers, found, 4, max_impacts=20_000)
    assert good.all()
    assert corners.min() > -1e-9
    at_rest = energy[some % 2 == 0]
    assert (np.diff(at_rest, axis=1) < 1e-9).all()
