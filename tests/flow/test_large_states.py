"""Machines of many degrees of freedom: states of arrays beside the same machine in numbers."""

import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

MASSES = 18


class Chain(vi.AbstractMachine):
    """Masses in a row on springs and dampers, the first of them shaken, the last before a stop."""

    springs: Any
    force: Any = 1.0
    law: Any = None
    written: str = eqx.field(static=True, default="slices")

    @property
    def stops(self):
        return (vi.RigidStop(0.5, 0.8),)

    @property
    def cycle(self):
        return 2 * jnp.pi / 0.4

    def position(self, state):
        return state[0][-1]

    def velocity(self, state):
        return state[1][-1]

    def placed(self, state, Y, V):
        return state[0].at[-1].set(Y), state[1].at[-1].set(V)

    def field(self, s, state):
        x, v = state
        y = x + 0.1 * v
        push = self.force * jnp.cos(0.4 * s)
        if self.written == "matrix":
            K = jnp.diag(self.springs + jnp.append(self.springs[1:], 0.0))
            K = K - jnp.diag(self.springs[1:], 1) - jnp.diag(self.springs[1:], -1)
            return v, (-K @ y).at[0].add(push)
        pull = self.springs * jnp.diff(y, prepend=0.0)
        if self.law is not None:
            pull = pull + self.law(x)
        return v, (jnp.append(pull[1:], 0.0) - pull).at[0].add(push)

    def start(self):
        return (jnp.zeros(self.springs.shape),) * 2


class Tuples(Chain):
    """The same, a number each."""

    def placed(self, state, Y, V):
        return (*state[0][:-1], Y), (*state[1][:-1], V)

    def field(self, s, state):
        x, v = state
        y = [a + 0.1 * b for a, b in zip(x, v, strict=True)]
        pull = [k * (a - b) for k, a, b in zip(self.springs, y, (0.0, *y[:-1]), strict=True)]
        found = [b - a for a, b in zip(pull, (*pull[1:], 0.0), strict=True)]
        return v, (found[0] + self.force * jnp.cos(0.4 * s), *found[1:])

    def start(self):
        return (tuple(jnp.zeros(()) for _ in range(MASSES)),) * 2


SPRINGS = jnp.linspace(1.0, 2.0, MASSES)


def flat(state):
    return np.concatenate([np.atleast_1d(x) for x in jax.tree.leaves(state)], axis=-1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "method",
    [
        vi.FixedStep(steps_per_cycle=40),
        pytest.param(vi.Adaptive(rtol=1e-9), marks=pytest.mark.exhaustive),
    ],
)
def test_arrays_are_numbers(method):
    def run(machine):
        return vi.simulate(machine, machine.start(), 4, settle=2, method=method)

    wanted = run(Tuples(tuple(SPRINGS)))
    assert int(wanted.impacts.sum()) > 2
    sections = np.stack([np.asarray(x) for x in jax.tree.leaves(wanted.sections)], axis=-1)
    for written in ("slices", "matrix"):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = run(Chain(SPRINGS, written=written))
        # Adaptive steps are chosen by a norm, whose rounding decides about the next step.
        atol = 1e-12 if isinstance(method, vi.FixedStep) else 2e-8
        np.testing.assert_allclose(flat(found.sections), sections, rtol=0, atol=atol)
        np.testing.assert_array_equal(found.impacts, wanted.impacts)


@pytest.mark.slow
def test_both_backends_and_every_lane_alone():
    method = vi.FixedStep(steps_per_cycle=40)
    forces = jnp.linspace(0.9, 1.1, 5)

    def last(force):
        machine = Chain(SPRINGS, force, written="matrix")
        return vi.simulate(machine, machine.start(), 3, method=method).last

    ours = vi.jit(jax.vmap(last))(forces)
    with vi.backend("xla"):
        theirs = vi.jit(jax.vmap(last))(forces)
    np.testing.assert_allclose(flat(ours), flat(theirs), rtol=0, atol=1e-12)
    alone = [flat(vi.jit(last)(force)) for force in forces[:2]]
    np.testing.assert_array_equal(flat(ours)[:2], alone)


@pytest.mark.slow
def test_derivatives_by_arrays_beside_differences():
    method = vi.FixedStep(steps_per_cycle=40)

    def loss(springs):
        machine = Chain(springs)
        run = vi.simulate(machine, machine.start(), 3, method=method)
        return jnp.sum(run.last[0] * jnp.arange(MASSES)) + run.y_min[-1]

    gradient, way = jax.grad(loss)(SPRINGS), jnp.cos(jnp.arange(MASSES))
    _, along = jax.jvp(loss, (SPRINGS,), (way,))
    np.testing.assert_allclose(gradient @ way, along, rtol=1e-10)
    step = 1e-6
    slope = (loss(SPRINGS + step * way) - loss(SPRINGS - step * way)) / (2 * step)
    np.testing.assert_allclose(along, slope, rtol=1e-6)


@pytest.mark.exhaustive
def test_a_network_as_a_force():
    """As a law of the springs: the same as XLA's."""
    network = eqx.nn.MLP("scalar", "scalar", 32, 2, jnp.tanh, key=jax.random.key(0))

    def last(force):
        machine = Chain(SPRINGS[:3], force, lambda x: 0.1 * jax.vmap(network)(x))
        return vi.simulate(machine, machine.start(), 1, method=vi.FixedStep(steps_per_cycle=20))

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ours = vi.jit(last)(1.0).last
    with vi.backend("xla"):
        np.testing.assert_allclose(flat(ours), flat(vi.jit(last)(1.0).last), rtol=0, atol=1e-11)


def test_a_thousand_numbers():
    """A wave that has not come to the end: the last mass rests, energy is what was put in."""
    machine = Chain(jnp.ones(500), force=0.0)
    x = jnp.zeros(500)
    start = x, x.at[0].set(1.0)
    run = vi.simulate(machine, start, 1, method=vi.FixedStep(steps_per_cycle=60))
    q, v = (np.asarray(x) for x in run.last)
    assert bool(run.successful) and abs(q[-1]) < 1e-12 and np.abs(v).max() > 0.05
    rest = vi.simulate(machine, (x, x), 1, method=vi.FixedStep(steps_per_cycle=60))
    np.testing.assert_array_equal(flat(rest.last), 0.0)


def test_wrong_fields_of_arrays():
    class Grown(Chain):
        def field(self, s, state):
            x, v = super().field(s, state)
            return x, jnp.append(v, 0.0)

    with pytest.raises((TypeError, ValueError), match="field"):
        vi.simulate(Grown(SPRINGS), (jnp.zeros(MASSES),) * 2, 1)
