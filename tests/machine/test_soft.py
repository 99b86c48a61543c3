"""Compliant stops: restitution in closed form, every law against SciPy, the rigid limit."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp

from differences import check_derivatives, quick
from event_by_event import followed
from thrown import thrown


@pytest.mark.parametrize(("exponent", "restitution"), [(1.0, 0.5), (1.5, 0.7), (2.0, 0.9)])
def test_restitution_does_not_depend_on_the_speed(exponent, restitution):
    speed = 10.0 ** np.arange(-3.0, 4.0)
    stop = vi.SoftStop(0.5, 100.0, restitution=restitution, law=vi.PowerLaw(exponent))

    def left(v):
        run = thrown(stop, v, jnp.maximum(3.0, 2.0 / v))
        return -run.last.V / v, run.successful

    found, good = vi.jit(jax.vmap(left))(jnp.asarray(speed))
    assert bool(good.all())
    np.testing.assert_allclose(found, restitution, atol=1e-9)


@pytest.mark.parametrize("exponent", [1.0, 1.5, 2.0])
def test_restitution_without_pull(exponent):
    """SciPy integrates the contact until the force vanishes; then the body flies freely."""
    law = vi.PowerLaw(exponent)
    for wanted in (0.05, 0.1353, 0.3, 0.7, 1.0):
        stop = vi.SoftStop(0.0, 9.0, restitution=wanted, law=law, adhesive=False)
        damping = float(stop.damping)

        def rate(t, y, damping=damping):
            return [y[1], -force(y[0], y[1], 9.0, damping=damping, law=law)]

        def pulls(t, y, damping=damping):
            return force(y[0], y[1], 9.0, damping=damping, law=law)

        pulls.terminal, pulls.direction = True, -1
        end = solve_ivp(rate, (0, 50), [1e-9, 2.0], events=pulls, rtol=1e-11, atol=1e-13).y[:, -1]
        np.testing.assert_allclose(-end[1] / 2.0, wanted, rtol=2e-5)
        # A traced restitution gives the same damping and its derivative.
        of = lambda e: vi.SoftStop(0.0, 9.0, restitution=e, law=law, adhesive=False).damping
        np.testing.assert_allclose(jax.jit(of)(wanted), damping, rtol=1e-12, atol=1e-15)
        if wanted < 1:
            h = 1e-5 * wanted
            difference = (of(wanted + h) - of(wanted - h)) / (2 * h)
            np.testing.assert_allclose(jax.grad(of)(wanted), difference, rtol=1e-6)


def test_a_body_leaves_a_stop_without_pull_with_its_restitution():
    found = jax.vmap(lambda e: thrown(
        vi.SoftStop(0.5, 100.0, restitution=e, adhesive=False), jnp.asarray(1.0), jnp.asarray(3.0)
    ).last.V)(jnp.array([0.3, 0.7]))  # fmt: skip
    np.testing.assert_allclose(found, [-0.3, -0.7], atol=1e-9)
    with pytest.raises(ValueError, match="`restitution` must be left out with `prestress`"):
        vi.SoftStop(0.5, 100.0, restitution=0.5, prestress=1.0)


def test_start_on_the_stop_touches_only_inwards():
    """Outwards the body flies freely; inwards the stop throws it back."""
    stop = vi.SoftStop(0.0, 100.0, restitution=0.5)
    run = jax.vmap(lambda v: thrown(stop, v, jnp.asarray(1.0), event_log=2))(jnp.array([-1.0, 1.0]))
    np.testing.assert_allclose(run.last.Y[0], -1.0, rtol=1e-14)
    assert float(run.last.V[1]) == pytest.approx(-0.5, abs=1e-9)
    assert jnp.sum(run.event_log.kind >= 0, axis=(1, 2)).tolist() == [0, 1]


SPRING = vi.PowerLaw()
LAWS = [
    {"damping": 1.2},
    {"damping": 0.6, "law": vi.HuntCrossley(1.5)},
    {"damping": 0.4, "prestress": 3.0, "law": vi.PowerLaw(2.0)},
    {"damping": 2.0, "law": vi.HuntCrossley(1.5), "prestress": 1.0},
]


def force(depth, rate, stiffness, *, damping=0.0, law=SPRING, prestress=0.0):
    """Return the contact force, written independently of the package."""
    depth = max(depth, 0.0)
    exponent = law.exponent
    spring = stiffness * depth**exponent
    if isinstance(law, vi.PowerLaw):
        resist = damping * np.sqrt(stiffness) * depth ** (0.5 * (exponent - 1)) * rate
    else:
        resist = damping * spring * rate
    return prestress + spring + resist


class Contact:
    """A stop for `solve_ivp`: its force, and the event that ends its mode."""

    def __init__(self, gap, stiffness, sign, adhesive, law):
        self.gap, self.stiffness, self.sign, self.law = gap, stiffness, sign, law
        self.adhesive, self.mode, self.changes = adhesive, "apart", 0

    def motion(self, x):
        return self.sign * x[0] - self.gap, self.sign * x[1]

    def push(self, x):
        touching = self.mode == "touching"
        return -self.sign * force(*self.motion(x), self.stiffness, **self.law) if touching else 0.0

    def ends(self, t, x):
        depth = self.motion(x)[0]
        if self.mode == "apart":
            return depth
        if self.adhesive or (self.mode == "touching" and depth < 1e-9):
            return -depth
        pushes = force(*self.motion(x), self.stiffness, **self.law)
        return max(-pushes if self.mode == "touching" else pushes, -depth)

    def change(self, x):
        self.changes += 1
        inside = self.motion(x)[0] > 1e-9
        if self.mode == "apart" or (self.mode == "released" and inside):
            self.mode = "touching"
        else:
            self.mode = "released" if inside else "apart"


def integrate_with_scipy(rate, x, contact, duration, max_step):
    """Return the state after a duration from SciPy's DOP853."""

    def jump(t, x):
        contact.change(x)
        return x

    return followed(rate, x, duration, [(contact.ends, jump)], max_step=max_step)[1]


@pytest.mark.parametrize(
    ("law", "adhesive"),
    quick([*((x, False) for x in LAWS), *((LAWS[i], True) for i in (1, 2))], (LAWS[3], False)),
    ids=str,
)
def test_laws_match_scipy(law, adhesive):
    side = "left" if "prestress" in law else "right"
    sign = 1 if side == "right" else -1
    stop = vi.SoftStop(0.5, 100.0, adhesive=adhesive, side=side, **law)
    speeds = np.array([0.2, 1.0, 5.0])
    run = vi.jit(jax.vmap(lambda v: thrown(stop, sign * v, 0.5 / v + 3.0)))(jnp.asarray(speeds))
    assert bool(run.successful.all())
    for i, v in enumerate(speeds):
        contact = Contact(0.5, 100.0, sign, adhesive, law)
        wanted = integrate_with_scipy(
            lambda t, x, c=contact: [x[1], c.push(x)], [0.0, sign * v], contact, 0.5 / v + 3.0,
            0.02 / max(1.0, v),
        )  # fmt: skip
        found = [run.last.Y[i], run.last.V[i]]
        np.testing.assert_allclose(found, wanted, atol=1e-8 * max(1, v))
        assert contact.changes >= 2
        if law.get("damping", 0) == 0:
            assert float(run.last.V[i]) == pytest.approx(-sign * v, abs=1e-10)


def scene_of(stiffness, **options):
    options = {"restitution": 0.5, **options}
    return vi.Scene(
        damping_ratio=0.0,
        drive=vi.IdealDrive(0.9),
        soft_stops=(vi.SoftStop(0.7, stiffness, **options),),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "method"),
    [({}, vi.FixedStep(steps_per_cycle=48)),
     ({"law": vi.PowerLaw(1.5), "adhesive": False}, vi.Adaptive(rtol=1e-12))],
    ids=["spring", "Hertz"],
)  # fmt: skip
def test_derivatives_through_a_contact(options, method):
    def last(x, **more):
        gap, stiffness, restitution, speed = x
        options_ = {**options, "restitution": restitution}
        scene = eqx.tree_at(lambda s: s.soft_stops[0].gap, scene_of(stiffness, **options_), gap)
        run = vi.simulate(scene, scene.start(Y=0.2, V=speed), 1, method=method, **more)
        return run.last, run.impacts

    step = [1e-6, 6e-5, 1e-6, 1e-6]
    check_derivatives(last, [0.7, 60.0, 0.5, 0.3], step=step, impacts=0)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"gap": float("inf")}, "`gap`"),
        ({"restitution": 1.1}, "`restitution`"),
        ({"restitution": 0.5, "damping": 0.1}, "`restitution` must be given without `damping`"),
    ],
)
def test_wrong_arguments_raise_with_their_names(arguments, told):
    with pytest.raises(ValueError, match=told):
        vi.SoftStop(**{"gap": 1.0, "stiffness": 10.0, **arguments})
    with pytest.raises(ValueError, match="`exponent`"):
        vi.PowerLaw(0.5)


def test_scene_raises_for_stops_of_the_wrong_kind():
    with pytest.raises(TypeError, match="`soft_stops`"):
        vi.Scene(0.0, vi.IdealDrive(1.0), soft_stops=(vi.RigidStop(1.0, 0.5),))
    with pytest.raises(TypeError, match="`stops`"):
        vi.Scene(0.0, vi.IdealDrive(1.0), stops=(vi.SoftStop(1.0, 10.0),))
    with pytest.raises(ValueError, match="ExactFlight"):
        scene = scene_of(50.0)
        vi.simulate(scene, scene.start(), 1, method=vi.ExactFlight())


def test_taylor_raises_for_a_force_without_a_series():
    machine = scene_of(100.0, law=vi.PowerLaw(1.5))
    with pytest.raises(ValueError, match="no power series"):
        vi.simulate(machine, machine.start(), 1, method=vi.Taylor())
    straight = scene_of(100.0)
    run = vi.simulate(straight, straight.start(), 1, method=vi.Taylor())
    assert bool(run.successful)


class Buffers(vi.Mechanical):
    """Two bodies with a buffer between them, in SI units: N/m and N s/m.

    Body `a` arrives at 2 m/s. Half a damped period multiplies the relative speed by
    exp(-πξ/√(1 - ξ²)), with ξ = c/(2√(K m)) and the reduced mass m."""

    q = ("a", "b")
    light: float = 1.0
    heavy: float = 3.0
    stiffness: float = 900.0
    dashpot: float = 9.0
    share: float = 0.6
    by_share: bool = False
    cycle = 1.0

    def mass(self, q):
        return self.light, self.heavy

    def force(self, t, q, v):
        return {"a": 0.0, "b": 0.0}

    @property
    def contacts(self):
        damping = {"restitution": self.share} if self.by_share else {"dashpot": self.dashpot}
        return vi.SoftStop(0.1, self.stiffness, on=lambda q: q.a - q.b, **damping)


@pytest.mark.parametrize("by_share", [False, True])
def test_buffer_between_bodies_matches_closed_form(by_share):
    masses = jnp.asarray([[1.0, 3.0], [0.2, 0.1], [40.0, 7.0], [1.0, 1.0]])

    def left(pair):
        machine = Buffers(light=pair[0], heavy=pair[1], by_share=by_share)
        run = vi.simulate(machine, machine.at(v={"a": 2.0}), 3, method=vi.Adaptive(rtol=1e-10))
        return run.last.v.a, run.last.v.b, run.successful

    a, b, good = vi.jit(jax.vmap(left))(masses)
    assert bool(good.all())
    m, M = np.asarray(masses).T
    xi = 9.0 / (2 * np.sqrt(900.0 * m * M / (m + M)))
    kept = 0.6 if by_share else np.exp(-np.pi * xi / np.sqrt(1 - xi**2))
    np.testing.assert_allclose(m * a + M * b, 2 * m, rtol=1e-12)
    np.testing.assert_allclose(b - a, 2 * kept, rtol=1e-8)
    with pytest.raises(ValueError, match="`dashpot` belongs to a `PowerLaw`"):
        vi.SoftStop(0.1, 900.0, dashpot=1.0, law=vi.HuntCrossley())


class Shaken(vi.Mechanical):
    """A body on a spring with a stop that does not pull, in a unit of length."""

    q, mass, cycle = ("x",), (1.0,), 2 * jnp.pi
    stiffness: Any = 1.0
    unit: Any = 1.0
    law: vi.AbstractContactLaw = eqx.field(static=True, default=vi.PowerLaw())
    is_rigid: bool = eqx.field(static=True, default=False)

    @property
    def contacts(self):
        if self.is_rigid:
            return vi.RigidStop(0.6 * self.unit, 0.7, on="x")
        more = {"restitution": 0.7, "adhesive": False, "law": self.law, "on": "x"}
        return vi.SoftStop(0.6 * self.unit, self.stiffness, **more)

    def force(self, t, q, v):
        return dict(x=1.3 * self.unit * jnp.cos(t) - 0.5 * q.x - 0.1 * v.x)


def ends_of(stiffness, units, **options):
    def end(stiffness, unit):
        machine = Shaken(stiffness, unit, **options)
        run = vi.simulate(machine, machine.at(), 2)
        return jnp.where(run.successful, run.last.x / unit, jnp.nan)

    given = jnp.broadcast_arrays(jnp.asarray(stiffness), jnp.asarray(units))
    return np.asarray(jax.jit(jax.vmap(end))(*given))


def test_a_stiff_stop_without_pull_is_a_rigid_one():
    """Regressions: the pull, with the stiffness in its unit, was compared with the depth. Ends were
    off by 1e-3 at a stiffness of 1e10, and the body passed the stop in single precision."""
    rigid = ends_of(1.0, [1.0], is_rigid=True)
    units = np.array([1.0, 1e6, 1e-6])
    low, high = ends_of(1e8, units), ends_of(1e10, units)
    # A contact lasts as long as the root of the compliance.
    np.testing.assert_allclose((10 * high - low) / 9, rigid[0], rtol=0, atol=1e-7)
    exact = ends_of(1e6, units)
    np.testing.assert_allclose(exact, exact[0], rtol=0, atol=1e-9)
    with jax.enable_x64(False):
        single = ends_of(1e6, units)
    np.testing.assert_allclose(single, exact, rtol=0, atol=1e-3)
