"""Two impacts that coincide on a branch come in the other order beyond."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from event_by_event import followed


def forces(s, a, va, b, vb, shift, cos):
    first = -a - 0.1 * va + 0.1 * (b - a) + cos(1.3 * s)
    return first, -1.2 * b - 0.1 * vb - 0.1 * (b - a) + cos(1.3 * s - shift)


class TwoBodies(vi.Mechanical):
    """Two bodies joined by a spring, each with its own force and stop."""

    shift: jax.Array | float = 0.3
    q, mass = ("a", "b"), (1.0, 1.0)
    contacts = (
        vi.RigidStop(0.3, 0.6, name="first", on="a"),
        vi.RigidStop(0.3, 0.6, name="second", on="b"),
    )
    cycle = 2 * np.pi / 1.3

    def force(self, s, q, v):
        return dict(zip("ab", forces(s, q.a, v.a, q.b, v.b, self.shift, jnp.cos), strict=True))


def after_a_cycle(x, shift):
    """Return the state after a cycle and the bodies that strike, by SciPy."""

    def rate(s, x):
        first, second = forces(s, *x, shift, np.cos)
        return x[1], first, x[3], second

    def bounced(s, x, body):
        x[2 * body : 2 * body + 2] = 0.3, -0.6 * x[2 * body + 1]
        return x

    events = [
        (lambda s, x, i=i: x[2 * i] - 0.3, functools.partial(bounced, body=i)) for i in range(2)
    ]
    return followed(rate, x, TwoBodies.cycle, events)[1:]


@pytest.mark.exhaustive
def test_a_switch_leads_to_the_other_order():
    machine = TwoBodies()
    start = machine.at(b=0.1)
    orbit = vi.find_orbit(machine, vi.simulate(machine, start, 6, settle=300).last)
    branch = vi.continue_orbit(orbit, parameter="shift", bounds=(-0.5, 0.5))
    (point,) = branch.special
    assert "coincide (first and second, at clock" in point.detail
    assert branch.ends == ("grazing", "bounds")
    other = point.switch()
    for motion, order in ((orbit, [0, 1]), (other, [1, 0])):
        state = motion.state
        x = np.asarray([state.a, state.v.a, state.b, state.v.b])
        later, struck = after_a_cycle(x, float(motion.machine.shift))
        assert struck == order
        np.testing.assert_allclose(later, x, atol=1e-9)
