"""Contacts of user-defined machines, compared with SciPy from event to event (rtol 1e-12) or with
closed forms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.optimize import brentq


class Oscillator(vi.AbstractMachine):
    omega: float = 0.9
    gap: float = 1.0
    restitution: float = 0.7
    cycle = 7.0

    def field(self, t, z):
        return dict(x=z.u, u=jnp.cos(self.omega * t) - z.x - 0.1 * z.u)


class Cart(vi.Mechanical):
    """A cart held by static friction, with a heavy load that a force pulls off it."""

    q = ("cart", "load")
    mass = (1.0, 100.0)
    cycle = 2 * jnp.pi
    contacts = (
        vi.DryFriction(0.1, on="cart", static_ratio=20.0),
        vi.DryFriction(0.1, on=lambda q: q.cart - q.load),
    )

    def force(self, t, q, v):
        return dict(cart=1.0, load=0.2 * jnp.sin(t))


@pytest.mark.slow
def test_as_many_contacts_stick_as_possible():
    """A sliding cart would be consistent too, as kinetic friction does not hold it. The load slides
    from π/6 until its momentum is spent."""
    run = vi.simulate(Cart(), Cart().at(), 1, event_log=4)
    end = brentq(lambda t: 0.2 * (np.cos(np.pi / 6) - np.cos(t)) - 0.1 * (t - np.pi / 6), 2, 4)
    assert abs(run.last.cart) < 1e-14 and abs(run.last.v.cart) < 1e-15
    np.testing.assert_allclose(run.event_log.phase[0, :2], (np.pi / 6, end), rtol=1e-9)


class Counted(vi.AbstractMachine):
    """A ball with two named modes, which count its impacts and the turns of a clock."""

    wrong: str = eqx.field(static=True, default="hits")
    cycle = 1.0
    modes = {"hits": 0.0, "turns": 0.0}  # noqa: RUF012

    @property
    def contacts(self):
        count = lambda m, t, z, hits, turns: {self.wrong: hits + 1}
        return vi.RigidStop(0.0, 0.5, "left", on=("x", "u"), modes=count)

    events = vi.Reset(
        lambda m, t, z, *_: t - 0.5,
        modes=lambda m, t, z, hits, turns: dict(turns=turns + 1, hits=hits),
    )

    def field(self, t, z, hits, turns):
        return dict(x=z.u, u=-1.0)


def test_modes_have_names():
    ball = vi.State(x=1.0, u=0.0)
    assert vi.simulate(Counted(), ball, 2).last.modes == (1, 2)  # it falls √2 s
    with pytest.raises(TypeError, match=r"the mode .hit., .* are hits, turns"):
        vi.simulate(Counted(wrong="hit"), ball, 2)


@pytest.mark.parametrize(
    ("field", "message"),
    [
        (lambda z: dict(x=z.u), "must return the components x, u, but 'u' is missing"),
        (lambda z: dict(x=z.u, u=0.0, w=1.0), "but there is no 'w'"),
        (lambda z: dict(x=z.u, u=z.w), "no component 'w'; it has x, u"),
    ],
)
def test_wrong_components_raise_with_their_names(field, message):
    class Wrong(Oscillator):
        def field(self, t, z):
            return field(z)

    with pytest.raises((TypeError, AttributeError), match=message):
        vi.simulate(Wrong(), vi.State(x=0.0, u=0.0), 1)


@pytest.mark.parametrize(
    ("contacts", "message"),
    [
        (vi.RigidStop(0.5, 0.8), r"no component 'Y'; it has x, u. Contacts name position and"),
        (vi.RigidStop(0.5, 0.8, on=("x", "v")), "no component 'v'; it has x, u"),
        (vi.RigidStop(0.5, 0.8, on="x"), "must be the names of position and velocity"),
        (vi.DryFriction(0.5, on="w"), "no component 'w'; it has x, u"),
        (lambda: vi.RigidStop(0.5, 0.8), "Write `@property` above its `def`"),
    ],
)
def test_wrong_contacts_raise(contacts, message):
    machine = type("Wrong", (Oscillator,), {"contacts": contacts})()
    with pytest.raises((TypeError, ValueError), match=message):
        vi.simulate(machine, vi.State(x=0.0, u=0.0))


def test_subclass_can_replace_a_parameter():
    wider = type("Wider", (Oscillator,), {"gap": 3.0})
    assert jax.tree.leaves((wider(), wider(gap=2.0))) == [0.9, 3.0, 0.7, 0.9, 2.0, 0.7]
    tuned = type("Tuned", (Oscillator,), {"gap": property(lambda self: 2 * self.omega)})
    assert jax.tree.leaves(tuned()) == [0.9, 0.7] and tuned(omega=0.5).gap == 1.0


def test_state_is_a_pytree_with_names():
    state = vi.State(x=1.0, v=vi.State(x=2.0))
    assert jax.tree.map(lambda x: 2 * x, state) == vi.State(x=2.0, v=vi.State(x=4.0))
    assert state.replace(x=3.0).x == 3.0 and state.x == 1.0
    assert repr(state) == "State(x=1, v=State(x=2))"
    for wrong, error in (
        (lambda: state.replace(y=1.0), TypeError),
        (lambda: state.y, AttributeError),
        (lambda: setattr(state, "x", 2.0), AttributeError),
        (lambda: vi.State(replace=1.0), ValueError),
    ):
        with pytest.raises(error):
            wrong()


class Toppling(vi.AbstractMachine):
    """A shaken pencil on its tip, until it falls to one side."""

    amplitude: float = 0.5
    cycle = 2 * jnp.pi / 3
    events = (
        vi.Reset(lambda m, t, z: z.x - 1.0, ends="right"),
        vi.Reset(lambda m, t, z: z.x + 1.0, ends="left", direction="falling"),
    )

    def field(self, t, z):
        return {"x": z.u, "u": z.x + self.amplitude * jnp.cos(3 * t)}

    def start(self):
        return vi.State(x=0.0, u=0.0)


def test_an_event_ends_the_motion_with_an_outcome():
    """Compare with the closed form x = A (eᵗ + e⁻ᵗ)/20 - A cos 3t/10 + u sinh t."""
    machine, speeds = Toppling(), jnp.array([0.3, -0.3, 0.03, -0.1])

    class Walled(Toppling):
        """The same with a wall on the right."""

        contacts = vi.RigidStop(1.0, 0.5, on=("x", "u"), ends="right")
        events = Toppling.events[1]

    def by_speed(machine):
        run = lambda u: vi.simulate(machine, vi.State(x=0.0, u=u), 4)
        clock, state = (lambda u: run(u).outcome_phase), (lambda u: run(u).outcome_state.u)
        return map(lambda f: jax.vmap(f)(speeds), (run, jax.jacrev(clock), jax.jacfwd(state)))

    run, by, by_state = by_speed(machine)
    assert run.outcomes == ("right", "left") and bool((run.result == vi.RESULTS.ended).all())
    t, at = np.linspace(0, 8, 4001), run.outcome_cycle * machine.cycle + run.outcome_phase
    places = 0.05 * np.cosh(t) - 0.05 * np.cos(3 * t) + np.outer(speeds, np.sinh(t))
    when = np.argmax(abs(places) > 1, axis=1)
    np.testing.assert_allclose(at, t[when], atol=2e-3)  # the spacing of t
    sides = np.sign(places[np.arange(4), when])
    np.testing.assert_array_equal(run.outcome, np.where(sides > 0, 0, 1))
    np.testing.assert_allclose(run.outcome_state.x, sides, atol=1e-12)
    speed = 0.05 * np.sinh(at) + 0.15 * np.sin(3 * at) + speeds * np.cosh(at)
    np.testing.assert_allclose(run.outcome_state.u, speed, atol=1e-7)
    bend = 0.05 * np.cosh(at) + 0.45 * np.cos(3 * at) + speeds * np.sinh(at)
    np.testing.assert_allclose(by, -np.sinh(at) / speed, rtol=1e-6)
    np.testing.assert_allclose(by_state, np.cosh(at) + bend * by, rtol=1e-6)
    assert "ended: right, 0 cycles and 1.79" in str(jax.tree.map(lambda x: x[0], run))
    assert str(run.to_xarray().outcome.values[1]) == "left"
    assert bool(jnp.isnan(run.duration[:, -1]).all())  # unreached cycles have no duration
    walled, by_wall, _ = by_speed(Walled())
    assert walled.outcomes == ("left", "right")
    np.testing.assert_array_equal(walled.outcome, 1 - run.outcome)
    np.testing.assert_allclose(by_wall, by, rtol=1e-6)
    axes = {"start.u": speeds, "amplitude": [0.5]}
    data = vi.scan(machine, axes, measure=(), cycles=4, derivatives="start.u", progress=False)
    np.testing.assert_allclose(data.d_outcome_phase.values.ravel(), by, rtol=1e-6)
    for name in ("outcome", "outcome_cycle", "outcome_phase"):
        np.testing.assert_allclose(data[name].values[:, 0], getattr(run, name), rtol=1e-7)


def test_an_event_in_both_directions():
    """Count the passages of a pendulum through its lowest position, in either direction."""

    class Counted(Toppling):
        events = vi.Reset(
            lambda m, t, z: z.x, lambda m, t, z: {"n[1]": z.n[1] + 1}, direction="both"
        )
        cycle = 2 * jnp.pi

        def field(self, t, z):
            return {"x": z.u, "u": -z.x, "n": jnp.zeros(2)}

    run = vi.simulate(Counted(), vi.State(x=1.0, u=0.0, n=jnp.zeros(2)), 5)
    assert run.last.n.tolist() == [0, 10]
