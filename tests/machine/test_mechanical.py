"""`Mechanical` machines, compared with SciPy from event to event, `Scene` and closed forms."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

CLOSE = vi.Adaptive(rtol=1e-12)


class Pair(vi.Mechanical):
    """Two bodies that collide, and a wall."""

    q = ("left", "right")
    mass = (1.0, 2.0)
    restitution: float = 0.7
    cycle = 2 * jnp.pi

    def force(self, t, q, v):
        left = jnp.cos(t) - q.left - 0.5 - 0.1 * v.left
        return dict(left=left, right=0.3 - q.right - 0.1 * v.right)

    @property
    def contacts(self):
        return (
            vi.RigidStop(0.0, self.restitution, on=lambda q: q.left - q.right),
            vi.RigidStop(1.0, self.restitution, on="right"),
        )


class SliderCrank(vi.Mechanical):
    """The machine of the paper in SI units, with its motor."""

    q = ("y", "phi")
    m_C: float = 0.35
    m_B: float = 0.2
    k0: float = 9 * jnp.pi**2
    c: float = 0.5
    a: float = 0.04
    J: float = 0.06
    T0: float = 10.0
    kappa: float = 1.1
    gap: float = 0.08
    restitution: float = 0.5
    cycle = vi.turn_of("phi")

    def slide(self, phi):
        return self.a * jnp.cos(phi)

    def mass(self, q):
        _, slope = jax.jvp(self.slide, (q.phi,), (jnp.ones_like(q.phi),))
        return self.m_C, self.J + self.m_B * slope**2

    def force(self, t, q, v):
        place, slope = jax.jvp(self.slide, (q.phi,), (jnp.ones_like(q.phi),))
        spring = self.k0 * (q.y - place)
        speed = self.kappa * jnp.sqrt(self.k0 / self.m_C)
        motor = self.kappa * self.T0 * (1 - v.phi / speed)
        return dict(y=-spring - self.c * v.y, phi=motor + spring * slope)

    @property
    def contacts(self):
        return vi.RigidStop(self.gap, self.restitution, on="y")

    def start(self):
        return self.at(v=dict(phi=15.0))


class Buffered(SliderCrank):
    """The same machine with an exact crank, and a buffer on the left."""

    def slide(self, phi):
        return self.a * (jnp.cos(phi) + 3 * (jnp.sqrt(1 - (jnp.sin(phi) / 3) ** 2) - 1))

    @property
    def contacts(self):
        buffer = vi.SoftStop(0.052, 20 * self.k0, restitution=0.6, side="left", on="y")
        return super().contacts, buffer


@pytest.mark.slow
def test_the_machine_of_the_paper():
    """Compare states, impact energies and events with `Scene` in both clocks."""
    parameters, machine = vi.Parameters(control=1.1), Buffered()
    scene, omega = parameters.scene(crank="slider"), float(parameters.natural_frequency)
    buffer = vi.SoftStop(1.3, 20.0, restitution=0.6, side="left")
    scene = dataclasses.replace(scene, soft_stops=(buffer,))
    start = scene.start(W=15.0 / omega)
    ours = vi.simulate(machine, machine.start(), 60, method=CLOSE, event_log=8)
    length, speed = 0.04, 0.04 * omega
    for clock in ("phase", "time"):
        theirs = vi.simulate(scene, start, 60, method=CLOSE, clock=clock, event_log=8)
        assert int(theirs.impacts.sum()) == int(ours.impacts.sum()) > 25
        touches, wanted = ((run.event_log.kind == 3).sum(axis=1) for run in (ours, theirs))
        np.testing.assert_array_equal(touches, wanted)
        z, w = ours.sections, theirs.sections
        np.testing.assert_allclose(z.y, length * w.Y, atol=1e-11)
        np.testing.assert_allclose(z.v.y, speed * w.V, atol=1e-10)
        np.testing.assert_allclose(z.v.phi, omega * w.W, atol=1e-10)
        lost = 0.35 * speed**2 * theirs.impact_energy
        np.testing.assert_allclose(ours.impact_energy, lost, atol=1e-10)
    np.testing.assert_allclose(ours.frequency_ratio, omega * theirs.frequency_ratio, rtol=1e-10)
    assert int(touches.sum()) > 50


@pytest.mark.slow
def test_turns_of_a_motor_are_its_cycles():
    """Start from rest, and compare the multipliers of an orbit with those in the phase clock."""
    parameters, machine = vi.Parameters(control=1.1), SliderCrank()
    scene, omega = parameters.scene(drive="motor"), float(parameters.natural_frequency)
    rest = vi.simulate(machine, machine.at(), 4)
    np.testing.assert_allclose(rest.duration, [0.457, 0.363, 0.361, 0.361], atol=5e-4)
    last = vi.simulate(machine, machine.start(), 1, settle=200).last
    orbit = vi.find_orbit(machine, last, throw=True)
    theirs = vi.simulate(scene, scene.start(W=15.0 / omega), 1, settle=200).last
    wanted = vi.find_orbit(scene, theirs, throw=True)
    assert float(orbit.duration) == pytest.approx(float(wanted.duration) / omega, rel=1e-9)
    found, other = (np.sort(abs(x.multipliers))[::-1] for x in (orbit, wanted))
    np.testing.assert_allclose(found[:3], other, atol=1e-8)


class Table(vi.Mechanical):
    """The machine of `BouncingBall` in the frame of the ground: a ball on a shaken table."""

    q = ("table", "ball")
    mass = (3.0,)
    shaking: float = 1.2
    restitution: float = 0.5
    cycle = 2 * jnp.pi

    def prescribed(self, t):
        return dict(table=-self.shaking * jnp.cos(t))

    def force(self, t, q, v):
        return dict(ball=-3.0)

    @property
    def contacts(self):
        return vi.RigidStop(0.0, self.restitution, "left", on=lambda q: q.ball - q.table)


@pytest.mark.slow
def test_a_ball_on_a_table_whose_motion_is_prescribed():
    """The ball bounces, rests on the table and leaves it again, as in `BouncingBall`."""

    def both(shaking):
        ours = Table(shaking=shaking)
        theirs = vi.machines.BouncingBall(acceleration=shaking)
        start = ours.at(ball=1.0 - shaking)
        found = vi.simulate(ours, start, 12, method=CLOSE)
        wanted = vi.simulate(theirs, theirs.start(height=1.0), 12, method=CLOSE)
        z, y = found.sections, wanted.sections
        apart = jnp.abs(z.ball - z.table - y.height) + jnp.abs(z.v.ball - z.v.table - y.speed)
        lost = jnp.abs(found.impact_energy - 3.0 * wanted.impact_energy)
        good = found.successful & jnp.all(found.impacts == wanted.impacts)
        return apart.max(), lost.max(), good, found.rests.sum()

    apart, lost, good, rests = vi.jit(jax.vmap(both))(jnp.array([0.9, 1.05, 1.2]))
    assert bool(good.all()) and int(rests.max()) > 3
    np.testing.assert_allclose(apart, 0, atol=1e-8)
    np.testing.assert_allclose(lost, 0, atol=1e-8)
    # A resting ball moves with the table, so its derivative is that of the table.
    ball = lambda x: vi.simulate(Table(shaking=x), Table(shaking=x).at(ball=1 - x), 12).last.ball
    assert float(jax.jacfwd(ball)(0.9)) == pytest.approx(-1.0, abs=1e-8)
    with pytest.raises(ValueError, match="The motion of 'table' is prescribed"):
        Table().at(table=1.0)


@pytest.mark.slow
def test_a_rest_on_a_moving_table_is_lost():
    """The distance has the rounding of two positions, which once ended branches too early. The last
    of the hops, summed up in closed form, ends as the table releases the ball again."""
    table = Table(shaking=1.3, restitution=0.7)
    last = vi.simulate(table, table.at(ball=-1.3), 1, settle=50).last
    orbit = vi.find_orbit(table, last, impact_log=40, throw=True)
    branch = vi.continue_orbit(orbit, parameter="shaking", bounds=(1.3, 1.4), progress=False)
    (lost,) = branch.special
    assert lost.kind == "rest" and branch.ends == ("bounds", "rest")
    np.testing.assert_allclose(lost.parameter, 1.33596602013, rtol=0, atol=1e-9)


class Pendulums(vi.Mechanical):
    """A double pendulum whose lower bob strikes a wall."""

    q = ("a", "b")
    m: float = 0.7
    cycle = 2.0

    def mass(self, q):
        across = self.m * jnp.cos(q.a - q.b)
        return [[1.0 + self.m, across], [across, self.m]]

    def force(self, t, q, v):
        return dict(a=-(1 + self.m) * jnp.sin(q.a), b=-self.m * jnp.sin(q.b))

    @property
    def contacts(self):
        return vi.RigidStop(0.5, 1.0, on=lambda q: jnp.sin(q.a) + jnp.sin(q.b))


@pytest.mark.slow
def test_masses_that_depend_on_all_coordinates_and_a_curved_gap():
    """Flights and elastic impacts conserve energy; `impact_energy` is the loss in other impacts."""
    machine = Pendulums()

    def energy(z):
        kinetic = 0.5 * (1 + machine.m) * z.v.a**2 + 0.5 * machine.m * z.v.b**2
        kinetic += machine.m * jnp.cos(z.a - z.b) * z.v.a * z.v.b
        return kinetic - (1 + machine.m) * jnp.cos(z.a) - machine.m * jnp.cos(z.b)

    start = machine.at(a=-1, b=-0.4)  # integers are accepted
    run = vi.simulate(machine, start, 20, method=CLOSE)
    assert int(run.impacts.sum()) > 6
    np.testing.assert_allclose(jax.vmap(energy)(run.sections), energy(start), atol=1e-9)

    class Loses(Pendulums):
        @property
        def contacts(self):
            return vi.RigidStop(0.5, 0.6, on=lambda q: jnp.sin(q.a) + jnp.sin(q.b))

    run = vi.simulate(Loses(), start, 5, method=CLOSE)
    lost = energy(start) - jax.vmap(energy)(run.sections)
    assert float(lost[-1]) > 0.1
    np.testing.assert_allclose(jnp.cumsum(run.impact_energy), lost[1:], atol=1e-9)


@pytest.mark.slow
def test_a_mass_matrix_of_three():
    """Three bodies have the same motion in absolute coordinates, two of them in an array, and in
    relative coordinates with a full mass matrix."""

    class Row(vi.Mechanical):
        q = ("s", "x[2]")
        mass = (1.0, np.array([2.0, 3.0]))
        cycle = 2 * jnp.pi
        contacts = vi.RigidStop(0.1, 0.5, on="x[1]"), vi.DryFriction(0.2, on=lambda q: q.x[0] - q.s)

        def force(self, t, q, v):
            return dict(s=jnp.cos(t) - q.s, x=0.5 * jnp.sin(t) * jnp.arange(2) - q.x)

    class Relative(vi.Mechanical):
        """The same bodies in the coordinates x, y - x, z - y."""

        q = ("x", "r", "s")
        mass = ((6.0, 5.0, 3.0), (5.0, 5.0, 3.0), (3.0, 3.0, 3.0))
        cycle = 2 * jnp.pi
        contacts = vi.RigidStop(0.1, 0.5, on=lambda q: q.x + q.r + q.s), vi.DryFriction(0.2, on="r")

        def force(self, t, q, v):
            y, z = q.x + q.r, q.x + q.r + q.s
            x, y, z = jnp.cos(t) - q.x, -y, 0.5 * jnp.sin(t) - z
            return dict(x=x + y + z, r=y + z, s=z)

    row, other = Row(), Relative()
    one = vi.simulate(row, row.at(x=jnp.array([0.3, -0.2])), 6, method=CLOSE)
    two = vi.simulate(other, other.at(r=0.3, s=-0.5), 6, method=CLOSE)
    z = two.sections
    assert int(one.impacts.sum()) == int(two.impacts.sum()) > 5
    np.testing.assert_allclose(one.sections.s, z.x, atol=1e-9)
    np.testing.assert_allclose(one.sections.x.T, (z.x + z.r, z.x + z.r + z.s), atol=1e-9)
    np.testing.assert_allclose(one.impact_energy, two.impact_energy, atol=1e-9)


def test_masses_that_depend_on_coordinates_are_the_same_in_an_array():
    class Names(vi.Mechanical):
        q = ("x", "y")
        cycle = 1.0

        def mass(self, q):
            return 2.0 + jnp.sin(q.x) * q.y, 3.0 + q.x**2

        def force(self, t, q, v):
            return dict(x=1.0, y=v.x - q.y)

    class Array(Names):
        q = ("a[2]",)

        def mass(self, q):
            return jnp.stack(super().mass(vi.State(x=q.a[0], y=q.a[1])))

        def force(self, t, q, v):
            return dict(a=jnp.stack([1.0, v.a[0] - q.a[1]]))

    one = Names().field(0.0, Names().at(x=0.4, y=-0.7, v={"x": 1.3, "y": 0.6}))
    other = Array().field(0.0, Array().at(a=np.array([0.4, -0.7]), v={"a": np.array([1.3, 0.6])}))
    np.testing.assert_allclose(other.v.a, [one.v.x, one.v.y], rtol=1e-14)


WRONG = [
    ({"mass": (1.0, 2.0, 3.0)}, "`mass` of a Wrong must be one for each of left, right"),
    ({"mass": 2.0}, "must be one for each of left, right, or 2 rows, but has 1"),
    ({"mass": [[1.0, 2.0], [2.0, 1.0]]}, "positive, or a symmetric and positive definite matrix"),
    ({"mass": [[1.0, 0.1], [0.0, 1.0]]}, "positive, or a symmetric and positive definite matrix"),
    ({"mass": lambda _, q: (q.left - 0.5, 1.0)}, "positive, or a symmetric and positive definite"),
    ({"mass": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]}, "with 2 columns, but has a row of 3"),
    ({"q": ("left", "left")}, "`q` of a Wrong must have different names"),
    ({"q": ("left", "v")}, "none of them `v`"),
    ({"contacts": vi.RigidStop(1.0, 0.5, on="left", mass=7.0)}, "whose own masses are used"),
    ({"contacts": vi.RigidStop(1.0, 0.5, on="up")}, "`along` of a contact must be one of the"),
    ({"contacts": vi.SoftStop(1.0, 9.0, on=("left", "v"))}, "must be one of the coordinates"),
]


@pytest.mark.parametrize(("members", "message"), WRONG)
def test_invalid_masses_and_names_raise(members, message):
    wrong = type(Pair)("Wrong", (Pair,), {"__module__": __name__, **members})
    start = vi.State(left=0.0, right=0.5, v=vi.State(left=0.0, right=0.0))
    with pytest.raises((TypeError, ValueError), match=message):
        vi.simulate(wrong(), start, 1)


class Driven(Pair):
    """The motion of the left body is given."""

    mass = (2.0,)
    size: float = 0.4

    def prescribed(self, t):
        return dict(left=self.size * jnp.sin(t) - 0.5)

    def force(self, t, q, v):
        return dict(right=-q.right)


def test_invalid_starts_raise():
    with pytest.raises(ValueError, match="'up' is not one of the coordinates left, right"):
        Pair().at(up=1.0)
    with pytest.raises(TypeError, match="`v` must be velocities by name"):
        Pair().at(v=0.3)
    with pytest.raises(ValueError, match=r"prescribed v\.left = 0\.5 at time 0, but has 0\.4"):
        vi.simulate(Driven(size=0.5), Driven().at(right=1.0), 1)
    vi.simulate(Driven(), vi.simulate(Driven(), cycles=2).last, 1)  # equal to rounding
    with pytest.raises(ValueError, match=r"phi before the end of a turn, but it is 0\.71"):
        vi.simulate(SliderCrank(), SliderCrank().at(phi=7.0, v=dict(phi=15.0)), 1)


@pytest.mark.slow
def test_given_motion_has_no_exponents():
    """The other body is an oscillator without damping."""
    machine = Driven(restitution=1.0)
    found = vi.lyapunov(machine, machine.at(right=0.9), 64, settle=0, progress=False)
    assert found.exponents.shape == (2,)


class Row(vi.Mechanical):
    """A coordinate that is an array."""

    q, mass, cycle = ("left", "x[3]"), (1.0, 2.0), 1.0

    def force(self, t, q, v):
        return dict(left=q.x[0], x=-q.x)


def test_starts_with_an_array_of_coordinates():
    start = Row().at(x=jnp.arange(3.0))
    last = jax.eval_shape(lambda x: vi.simulate(Row(), x, 1).last, start)
    assert last.x.shape == last.v.x.shape == (3,)
    assert Row().velocity(start.replace(v=start.v.replace(left=2.0))) == 2.0  # no contact names it
    short = start.replace(x=jnp.zeros(2))
    with pytest.raises(TypeError, match=r"must be one state .* its x has shape \(2,\), not \(3,\)"):
        vi.simulate(Row(), short, 1)


def test_missing_masses_and_forces_raise():
    class Array(Pair):
        q, mass = ("left[2]", "right"), ((1.0, 0.0), (0.0, 1.0))

    with pytest.raises(ValueError, match="must be a number or an array for each of its coord"):
        Array().field(0.0, Array().at())

    class Nameless(Pair):
        def force(self, t, q, v):
            return q.left

    with pytest.raises(TypeError, match=r"must return forces by name, `dict\(left=..., right="):
        vi.simulate(Nameless(), Nameless().at(), 1)

    class Massless(vi.Mechanical):
        q = ("left",)
        cycle = 1.0

        def force(self, t, q, v):
            return {"left": 0.0}

    with pytest.raises(TypeError, match="A Massless must have `mass`: one for each"):
        vi.simulate(Massless(), Massless().at(), 1)


def test_parameters_may_have_natural_names():
    """Names that the package uses itself are private, or refused (`test_mistakes`)."""
    names = (
        "places masses length mass gap speed radius load period time energy momentum state mode "
        "free_names q_names q_shapes width height stiffness damping gravity amplitude frequency "
        "phase restitution friction offset stroke torque power clearance clock section parts"
    ).split()

    class Plain(vi.Mechanical):
        q, mass, cycle = ("x",), 1.0, 1.0
        contacts = vi.RigidStop(0.1, 0.5, on="x")

        def force(self, t, q, v):
            return dict(x=len(names) - 40 * q.x)

    force = lambda self, t, q, v: dict(x=sum(getattr(self, n) for n in names) - 40 * q.x)
    kind = type("Natural", (Plain,), {
        "__annotations__": dict.fromkeys(names, float), "__module__": __name__, "force": force,
        **{name: 1.0 for name in names},
    })  # fmt: skip
    ends = [vi.simulate(x, x.at(), 1).last for x in (kind(), Plain())]
    np.testing.assert_allclose(ends[0].x, ends[1].x, rtol=1e-13)
    np.testing.assert_allclose(ends[0].v.x, ends[1].v.x, rtol=1e-13)

    class Helpers(Plain):
        def places(self, count):
            return [0.1 * i for i in range(count)]

        def masses(self):
            return [1.0]

    assert vi.simulate(Helpers(), Helpers().at(), 1).last.x == ends[1].x
