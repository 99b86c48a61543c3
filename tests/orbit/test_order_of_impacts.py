"""Two impacts that coincide on a branch come in the other order beyond."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from shooting import flown


class Both(eqx.Module):
    a: jax.Array
    va: jax.Array
    b: jax.Array
    vb: jax.Array


class TwoBodies(vi.AbstractMachine):
    """Two bodies joined by a spring, each with its own force and stop."""

    shift: jax.Array | float = 0.3
    contacts = (vi.RigidStop(0.3, 0.6, name="first"), vi.RigidStop(0.3, 0.6, name="second",
                                                               coordinate=1))  # fmt: skip
    cycle = 2 * np.pi / 1.3

    @property
    def coordinates(self):
        return (
            vi.Coordinate(lambda x: x.a, lambda x: x.va, lambda x, Y, V: Both(Y, V, x.b, x.vb)),
            vi.Coordinate(lambda x: x.b, lambda x: x.vb, lambda x, Y, V: Both(x.a, x.va, Y, V)),
        )

    def field(self, s, x):
        return Both(*field(s, (x.a, x.va, x.b, x.vb), self.shift, jnp.cos))

    def start(self):
        return Both(*map(jnp.asarray, (0.0, 0.0, 0.1, 0.0)))


def field(s, x, shift, cos):
    a, va, b, vb = x
    first = -a - 0.1 * va + 0.1 * (b - a) + cos(1.3 * s)
    return va, first, vb, -1.2 * b - 0.1 * vb - 0.1 * (b - a) + cos(1.3 * s - shift)


def after_a_cycle(x, shift):
    """Return the state after a cycle and the bodies that strike, by SciPy."""
    s, guards, struck = 0.0, [lambda s, y: y[0] - 0.3, lambda s, y: y[2] - 0.3], []
    while True:
        rate = lambda s, y: field(s, y, shift, np.cos)
        body, s, x, _ = flown(rate, s, x, TwoBodies.cycle, guards)
        if body is None:
            return x, struck
        struck.append(body)
        x[2 * body : 2 * body + 2] = 0.3, -0.6 * x[2 * body + 1]


@pytest.mark.exhaustive
def test_a_switch_leads_to_the_other_order():
    machine = TwoBodies()
    orbit = vi.find_orbit(machine, vi.simulate(machine, machine.start(), 6, settle=300).last)
    branch = vi.continue_orbit(orbit, parameter="shift", bounds=(-0.5, 0.5))
    (point,) = branch.special
    assert "coincide (first and second, at clock" in point.detail
    assert branch.ends == ("grazing", "bounds")
    other = point.switch()
    for motion, order in ((orbit, [0, 1]), (other, [1, 0])):
        x = np.asarray(jax.tree.leaves(motion.state))
        later, struck = after_a_cycle(x, float(motion.machine.shift))
        assert struck == order
        np.testing.assert_allclose(later, x, atol=1e-9)
