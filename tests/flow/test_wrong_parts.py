"""Wrong parts of user-defined machines: each error names the part and what it must be."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
import vi_jax as vi


def guard(machine, s, state):
    return state.Y - 0.5


def back(machine, s, state):
    return vi.OscillatorState(-state.Y, state.V)


class Swing(vi.AbstractMachine):
    """x'' = -x with a reset; its parts are replaced by wrong ones."""

    event: tuple = eqx.field(static=True, default=())
    parts: tuple = ()
    cycle = 6.0

    @property
    def events(self):
        return self.event

    @property
    def contacts(self):
        return self.parts

    def field(self, s, state, *modes):
        return vi.OscillatorState(state.V, -state.Y)


START = vi.OscillatorState(jnp.asarray(0.0), jnp.asarray(1.0))


class NoModes(vi.AbstractEvent):
    def guard(self, machine, s, state, *modes):
        return state.Y - 0.5

    def after(self, machine, s, state, *modes):
        return state


@pytest.mark.parametrize(
    ("event", "message"),
    [
        (vi.Reset(lambda m, s, x: jnp.stack([x.Y, x.V]), back), r"`guard` of event 0 .* one float"),
        (vi.Reset(lambda m, s, x: x.Y > 0.5, back), r"`guard` of event 0 .* bool"),
        (vi.Reset(guard, lambda m, s, x: (x.Y, x.V)), r"state after event 0 \(Reset\) of a Swing"),
        (vi.Reset(guard, lambda m, s, x: None), r"`reset` of a Reset .* `return` is missing"),
        (
            vi.Reset(guard, lambda m, s, x: vi.OscillatorState(x.Y[None], x.V), name="kick"),
            r"state after event 0 \(kick\) .*f64\[1\]",
        ),
        (
            vi.Reset(guard, lambda m, s, x: jax.tree.map(lambda x: jnp.asarray(1), x)),
            r"state after event 0 .*i64\[\]",
        ),
        (vi.Reset(guard, back, modes=lambda m, s, x: (1.0,)), "modes after event 0 .* must be 0"),
        (NoModes(), r"event 0 \(NoModes\) of a Swing must return the state and the modes"),
    ],
)
def test_events(event, message):
    with pytest.raises(TypeError, match=message):
        vi.simulate(Swing(event=(event,)), START, 1)


def test_parts_are_tuples_of_their_kind():
    stop, switch = vi.RigidStop(0.5, 0.8), vi.Switch(lambda m, t, z: z.Y)
    for events in ((guard,), (stop,)):
        with pytest.raises(TypeError, match="`events` of a Swing must be a tuple of `AbstractEv"):
            vi.simulate(Swing(event=events), START, 1)
    for contacts in (vi.Reset(guard, back), switch):
        with pytest.raises(TypeError, match="`contacts` of a Swing must be a tuple of contacts"):
            vi.find_orbit(Swing(parts=(contacts,)), START)


class Springs(vi.AbstractMachine):
    k: Any = eqx.field(default_factory=lambda: jnp.array([1.0, 2.0]))
    gap: Any = 9.0
    restitution: Any = 0.5
    cycle: Any = 3.0
    on: Any = eqx.field(static=True, default=("x[0]", "v[0]"))

    @property
    def contacts(self):
        return vi.RigidStop(self.gap, self.restitution, on=self.on)

    def field(self, s, state):
        return dict(x=state.v, v=-self.k * state.x)


class Squares(Springs):
    def quantities(self, s, state):
        return {"square": state.x**2}


ROWS = vi.State(x=jnp.zeros(2), v=jnp.ones(2))


@pytest.mark.parametrize(
    ("machine", "words"),
    [
        (Springs(k=jnp.array([1.0, jnp.nan])), "`machine` must hold numbers, but its k is"),
        (Springs(gap=jnp.array([9.0])), r"must have one number as `gap`, but has shape \(1,\)"),
        (Springs(restitution=jnp.ones(2)), r"one number as `restitution`, but has shape \(2,\)"),
        (Springs(cycle=jnp.ones(1)), r"`cycle` of a Springs must be one number, but has shape"),
        (Springs(on=("x[2]", "v[2]")), r"no component 'x\[2\]'; 'x' has the shape \(2,\)"),
        (Springs(on=("x", "v")), r"shape \(2,\). A contact names numbers of arrays, .on="),
        (Squares(), "`quantities` of a Squares must be numbers, but 'square' is an array"),
    ],
)
def test_arrays_in_place_of_numbers_raise(machine, words):
    with pytest.raises((TypeError, ValueError), match=words):
        vi.simulate(machine, ROWS, 2)
