"""Parts of machines that a user may write in several ways, and what messages say about them."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.flow.machine_checks import check_parts
from vi_jax.flow.results import code_of_outcome, outcome_of
from vi_jax.machine import events_of, stop_in_words
from vi_jax.orbit import multipliers_in_words


class Balls(vi.Mechanical):
    """Two balls on top of each other, with or without a floor: a compile-time constant."""

    floor: bool = True

    q = ("x", "y")
    mass = (1.0, 1.0)
    cycle = 5.0

    def gap(self, q):
        return q.y - q.x

    @property
    def contacts(self):
        meet = vi.RigidStop(0.0, 0.5, "left", on=self.gap)
        return (meet, vi.RigidStop(0.0, 0.5, "left", on="x")) if self.floor else meet

    def force(self, t, q, v):
        return dict(x=-1.0, y=-1.0)


def test_a_boolean_parameter_and_a_method_as_gap():
    start = Balls().at(x=1.0, y=2.0)
    lying = vi.simulate(Balls(), start, 1).last
    np.testing.assert_array_equal([lying.x, lying.y, lying.v.x, lying.v.y], 0.0)
    falling = vi.simulate(Balls(floor=False), start, 1).last
    np.testing.assert_allclose([falling.x, falling.y], [-11.5, -10.5], rtol=1e-12)


def test_a_constant_that_is_not_a_number_gives_not_finite():
    class Larger(vi.AbstractMachine):
        cycle = 1.0

        def field(self, t, z):
            return dict(x=jnp.maximum(z.x, jnp.nan))

    for backend in ("auto", "xla"):
        with vi.backend(backend):
            run = vi.simulate(Larger(), vi.State(x=1.0), 1)
        assert run.result == vi.RESULTS.not_finite


class Arrayed(vi.AbstractMachine):
    """x'' = -x with the velocity in an array, in which another number decays."""

    cycle = vi.rising("x", usual=6.0)

    def field(self, t, z):
        return dict(x=z.w[0], w=jnp.stack([-z.x, -z.w[1]]))


def test_an_array_may_follow_a_number_in_a_state_with_a_section():
    run = vi.simulate(Arrayed(), vi.State(x=0.0, w=jnp.ones(2)), 3)
    np.testing.assert_allclose(run.duration, 2 * np.pi, rtol=1e-8)
    np.testing.assert_allclose(run.last.w, [1.0, np.exp(-6 * np.pi)], rtol=1e-7)
    assert run.labels == ("x", "x")


class Ending(vi.AbstractMachine):
    """x' = 1, with an outcome at each of many places; the start lies before the given one."""

    number: int = eqx.field(static=True)

    cycle = 1.0

    @property
    def events(self):
        return tuple(
            vi.Reset(lambda m, t, z, i=i: z.x - i, ends=f"at {i}") for i in range(self.number)
        )

    def field(self, t, z):
        return dict(x=1.0 + 0.0 * z.x)


NUMBERS = [0, 1, 63, 64, 65, 1000, 4094]


def test_more_than_63_outcomes():
    for kind in (jnp.float32, jnp.float64):
        reasons = jnp.asarray([code_of_outcome(n) for n in NUMBERS], kind)
        np.testing.assert_array_equal(jax.vmap(outcome_of)(reasons), NUMBERS)
    with pytest.raises(ValueError, match=r"at most 4095 outcomes \(`ends`\), but have 5000"):
        check_parts(Ending(5000))


class Arrays(vi.AbstractMachine):
    cycle = 1.0

    def field(self, t, z):
        return dict(x=-z.x)


class Old(vi.AbstractMachine):
    cycle = 6.0

    def field(self, t, z):
        return dict(x=z.u, u=-z.x)

    def section(self, z):
        return z.u


class Toggled(vi.AbstractMachine):
    cycle = 1.0
    contacts = vi.RigidStop(0.15, 0.75, on=("x", "u"))

    def field(self, t, z, k):
        return dict(x=z.u, u=-(1 + 0.25 * k) * z.x)


class Compliant(vi.AbstractMachine):
    exponent: float = 1.5
    cycle = 5.0

    @property
    def contacts(self):
        return vi.SoftStop(0.0, 1.0, law=vi.PowerLaw(self.exponent), on=("x", "u"))

    def field(self, t, z):
        return dict(x=z.u, u=-1.0)


BODY = vi.State(x=0.1, u=0.0)


@pytest.mark.parametrize(
    ("machine", "start", "kind", "words"),
    [
        (Arrays(), vi.State(x=jnp.ones(3)), ValueError, r"`def position\(self, z\): return z.x"),
        (Toggled(), BODY, TypeError, r"declare them: `modes = dict\(k=0.0\)`"),
        (Compliant(), BODY, TypeError, r"`exponent` .* compile-time constant.*static=True"),
        (Balls(), Balls().at(x=-1.0), ValueError, "at .gap on the right, at -gap on the left"),
    ],
)
def test_messages_say_what_to_write(machine, start, kind, words):
    with pytest.raises(kind, match=words):
        vi.simulate(machine, start, 1)


def test_a_section_of_the_past_is_warned_of():
    with pytest.warns(UserWarning, match=r"`section` of a Old has no effect.*vi.rising"):
        vi.simulate(Old(), BODY, 1)


class Circuit(vi.AbstractMachine):
    cycle = 1.0
    units = {"volt": "V"}  # noqa: RUF012

    def field(self, t, z):
        return dict(volt=-z.volt, i=-2 * z.i)


class Pair(vi.AbstractMachine):
    cycle = 1.0
    contacts = (
        vi.RigidStop(0.5, 0.6, on=("a", "u")), vi.RigidStop(0.3, 0.6, on=("b", "v")),
        vi.RigidStop(0.9, 0.6, on=("b", "v"), name="buffer"),
        vi.RigidStop(0.3, 0.6, "left", on=("b", "v")), vi.SoftStop(0.8, 1.0, on=("b", "v")),
        vi.SoftStop(0.9, 1.0, on=("b", "v")),
    )  # fmt: skip

    def field(self, t, z):
        return dict(a=z.u, b=z.v, u=-z.a, v=-z.b)


def test_prints():
    text = str(vi.simulate(Circuit(), vi.State(volt=50.0, i=1e-30), 1))
    assert "volt in [18.394, 50] V" in text and "i = 0\n" in text
    assert "rtol=1e-09" in str(vi.Adaptive(rtol=1e-9))
    assert multipliers_in_words([0.5, 1e-3 - 2e-3j, -1e-3 + 1e-17j, 1e-17], 3, 1e-12) == [
        "0.5", "0.001-0.002i", "-0.001", "0"
    ]  # fmt: skip
    machine = Pair()
    stops = [x for x in events_of(machine) if isinstance(x, vi.RigidStop | vi.SoftStop)]
    assert [stop_in_words(machine, x) for x in stops] == [
        "right stop of a", "right stop of b", "buffer", "left stop", "right soft stop 0",
        "right soft stop 1",
    ]  # fmt: skip


def test_logs_name_their_stops():
    class Few(Pair):
        contacts = Pair.contacts[:3:2]

    run = vi.simulate(Few(), vi.State(a=0.0, b=0.5, u=1.0, v=1.0), 1, impact_log=4, event_log=4)
    first, second = str(run.event_log), str(run.impact_log)
    assert "impact (right stop) at " in first and "impact (buffer) at " in first
    assert "right stop at " in second and "buffer at " in second


class Rocking(vi.AbstractMachine):
    """A block that loses energy as it passes the upright, which its torque depends on."""

    first: str = eqx.field(static=True)

    cycle = 10.0

    @property
    def events(self):
        switch = vi.Switch(lambda m, t, z: z.th)
        slows = lambda m, t, z, s: dict(w=0.9 * z.w)
        loss = vi.Reset(lambda m, t, z, s: z.th, slows, direction="both")
        return (switch, loss) if self.first == "switch" else (loss, switch)

    def field(self, t, z, s):
        return dict(th=z.w, w=-jnp.sin(0.25 * s - z.th))


@pytest.mark.parametrize("first", ["switch", "reset"])
def test_a_switch_and_a_reset_on_one_surface_are_logged_once(first):
    run = vi.simulate(Rocking(first), vi.State(th=0.2, w=0.0), 1, event_log=20, method="reference")
    log = run.event_log
    kinds = np.asarray(log.kind[0])
    modes, resets = (vi.EVENTS.index(x) for x in ("mode", "reset"))
    assert np.count_nonzero(kinds == modes) == np.count_nonzero(kinds == resets) == 4
    np.testing.assert_allclose(
        log.phase[0][kinds == modes], log.phase[0][kinds == resets], atol=1e-12
    )
    # From the same motion with a rigid stop at |th| = 0, with the modes of both sides.
    np.testing.assert_allclose(run.last.th, 0.0552197656, atol=1e-9)
    full = vi.simulate(Rocking(first), vi.State(th=0.2, w=0.0), 1, event_log=3).event_log
    assert "events after the first 3 are not listed; 1 cycle may have more" in str(full)
    assert "mode (switch 0 becomes" in str(full) and "may have more" not in str(log)


class Loaded(vi.AbstractMachine):
    cycle = 1.0
    contacts = vi.DryFriction(0.5, on="u", load=lambda t, z: 1.0 + t)

    def field(self, t, z):
        return dict(x=z.u, u=0.0 * z.u)


def test_a_load_with_another_period_is_named_if_cycles_repeat():
    start = vi.State(x=0.0, u=2.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run = vi.simulate(Loaded(), start, 1, event_log=2)
    with pytest.warns(UserWarning, match=r"`contacts` of a Loaded are not the same.*force on its"):
        vi.simulate(Loaded(), start, 2)
    assert "switch" not in str(run.event_log)
    with pytest.raises(TypeError, match=r"Compare it with `vi.RESULTS.successful`"):
        int(run.result)
