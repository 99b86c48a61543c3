"""Simultaneous events, events that do not happen, and bodies at rest when a force jumps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

State = vi.OscillatorState


def start_at(Y, V):
    return State(jnp.asarray(float(Y)), jnp.asarray(float(V)))


class Glider(vi.AbstractMachine):
    """A body without forces."""

    events: tuple = ()
    contacts: tuple = ()
    cycle = 4.0

    def field(self, s, state):
        return State(state.V, 0 * state.V)


def faster(machine, s, state):
    return State(state.Y, state.V + 1)


def same(machine, s, state):
    return state


def test_a_cycle_ends_at_the_instant_of_an_impact():
    ends = (vi.Reset(lambda m, s, x: s - 1.0, same, ends_cycle=True),)
    machine = Glider(contacts=(vi.RigidStop(1.0, 0.5),), events=ends)
    run = vi.simulate(machine, start_at(0, 1), 1)
    assert float(run.duration[0]) == pytest.approx(1.0, abs=1e-12)
    assert float(run.last.V) == pytest.approx(-0.5)


def test_an_event_that_does_not_happen_leaves_no_trace():
    no = (vi.Reset(lambda m, s, x: x.Y - 1, faster, when=lambda m, s, x: x.Y > 9),)

    def last(V):
        return vi.simulate(Glider(events=no), State(jnp.asarray(0.0), V), 1).last.Y

    value, slope = jax.value_and_grad(last)(jnp.asarray(1.0))
    assert float(value) == pytest.approx(4.0, abs=1e-14)
    assert float(slope) == pytest.approx(4.0, abs=1e-14)


def test_reset_checks_its_condition_when_its_guard_rises():
    """A hand passes 1 at s = 1, before the condition s > 1.5 holds. If it turns, it passes again at
    5 and 9. A guard with both conditions rises at 1.5."""

    def counted(machine, s, state):
        return {"count": state.count + 1}

    class Hand(vi.AbstractMachine):
        cycle = 10.0
        events = (
            vi.Reset(lambda m, s, x: x.place - 1, counted, when=lambda m, s, x: s > 1.5),
            vi.Reset(
                lambda m, s, x: jnp.minimum(x.place - 1, s - 1.5), lambda m, s, x: {"both": s}
            ),
            vi.Reset(
                lambda m, s, x: x.place - 4,
                lambda m, s, x: {"place": 0.0},
                when=lambda m, s, x: x.turns > 0,
            ),
        )

        def field(self, s, x):
            return {"place": 1.0, "turns": 0.0, "count": 0.0, "both": 0.0}

    def last(turns):
        start = vi.State(place=0.0, turns=turns, count=0.0, both=0.0)
        return vi.simulate(Hand(), start, 1).last

    found = jax.vmap(last)(jnp.array([0.0, 1.0]))
    np.testing.assert_array_equal(found.count, [0, 2])  # not at 1, but at 5 and 9
    np.testing.assert_allclose(found.both, [1.5, 9.0], rtol=1e-12)
    np.testing.assert_allclose(found.place, [10.0, 2.0], rtol=1e-12)


def test_event_that_does_not_happen_ends_no_cycle():
    third = vi.Reset(
        lambda m, s, x: jnp.sin(x.Y), same, when=lambda m, s, x: x.Y > 7, ends_cycle=True
    )
    run = vi.simulate(Glider(events=(third,)), start_at(1, 1), 1)
    assert float(run.duration[0]) == pytest.approx(4 * jnp.pi - 1, abs=1e-9)


class Pressed(Glider):
    """A body on the left stop, whose force is part of its state."""

    contacts: tuple = (vi.RigidStop(0.0, 0.0, "left", on=("Y", "V")),)
    events: tuple = (vi.Reset(lambda m, s, x: s - 2.0, lambda m, s, x: {"force": -x.force}),)

    def field(self, s, state):
        return {"Y": state.V, "V": state.force, "force": 0.0}


def test_jump_of_its_force_releases_a_body():
    run = vi.simulate(Pressed(), vi.State(Y=0.0, V=0.0, force=-1.0), 1, event_log=4)
    assert float(run.last.Y) == pytest.approx(0.5 * 2**2, abs=1e-12)
    assert [vi.EVENTS[int(k)] for k in run.event_log.kind[0, :2]] == ["reset", "release"]


class Lever(vi.Mechanical):
    """Body y rests on the left stop, until an impact of body x reverses its force."""

    q = ("x", "y")
    mass = (1.0, 1.0)
    cycle = 4.0
    modes = {"way": -1.0}  # noqa: RUF012
    contacts = (
        vi.RigidStop(0.0, 0.0, "left", on="y"),
        vi.RigidStop(1.0, 0.5, on="x", modes=lambda m, s, z, way: 1.0),
    )

    def force(self, t, q, v, way):
        return dict(x=0.0, y=way)


@pytest.mark.slow
def test_impact_of_another_body_releases_a_body():
    run = vi.simulate(Lever(), Lever().at(v=dict(x=0.5)), 1, event_log=4)
    assert [vi.EVENTS[int(k)] for k in run.event_log.kind[0, :2]] == ["impact", "release"]
    assert float(run.last.y) == pytest.approx(0.5 * 2**2, abs=1e-12)
    assert float(run.last.x) == pytest.approx(1 - 2 * 0.25, abs=1e-12)


class Pulled(vi.Mechanical):
    """A block on a floor. The pull on it jumps at t = 1."""

    slope: jax.Array | float = 0.0
    q = ("x", "y")
    mass = (1.0, 1.0)
    cycle = 3.0
    contacts = vi.RigidStop(0.0, 0.0, "left", on="y", friction=1.0, along="x")
    events = vi.Switch(lambda machine, s, state: s - 1.0)

    def force(self, t, q, v, on):
        return dict(x=jnp.where(on > 0, 2.0 + self.slope * (t - 1), 0.5), y=-1.0)


@pytest.mark.slow
def test_friction_releases_a_block_as_the_pull_jumps():
    """The pull then stays, grows or falls: u = ∫(pull - 1) ds over 2."""
    slopes = jnp.array([0.0, 0.1, -0.1])
    run = jax.vmap(lambda slope: vi.simulate(Pulled(slope=slope), Pulled().at(), 1))(slopes)
    np.testing.assert_allclose(run.last.v.x, 2.0 + 2 * slopes, atol=1e-12)


def test_reset_onto_the_guard_of_another_does_not_trigger_it():
    """A reset moves Y from 1 to -1, where the guard of the other reset is zero."""
    back = vi.Reset(lambda m, s, x: x.Y - 1, lambda m, s, x: State(x.Y - 2, x.V))
    below = vi.Reset(lambda m, s, x: -1 - x.Y, faster)
    run = vi.simulate(Glider(events=(back, below)), start_at(0, 1), 1, event_log=4)
    assert run.event_log.number[0].tolist() == [0, 0, -1, -1]
    assert (float(run.last.Y), float(run.last.V)) == pytest.approx((0.0, 1.0), abs=1e-12)
