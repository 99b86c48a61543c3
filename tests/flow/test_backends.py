"""The two backends, vector code and XLA, give the same motion up to rounding."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.machine.base import AbstractMachine

from differences import quick

PRESSED = (vi.RigidStop(0.3, 0.4),)


def ideal(ratio):
    return vi.Scene(damping_ratio=0.05, drive=vi.IdealDrive(ratio), stops=PRESSED)


def motor(kappa):
    return vi.Parameters(torque=10.0, restitution=0.5, gap=0.05, control=kappa).scene()


class Ball(AbstractMachine):
    """A ball that falls on a stop at 1. Each impact ends a cycle, earlier than `cycle` would."""

    restitution: Any
    cycle = 6.0

    @property
    def contacts(self):
        return (vi.RigidStop(1.0, self.restitution, ends_cycle=True),)

    def field(self, s, state):
        return vi.OscillatorState(state.V, jnp.ones_like(state.Y))

    def start(self, Y, V):
        return vi.OscillatorState(jnp.asarray(Y), jnp.asarray(V))


# Values: the scene as a function of the lane's parameter, the method, options of `simulate`.
CASES = {
    "cycles that an impact ends": (
        lambda r: Ball(0.6 * r), vi.Adaptive(), {"record": "sections", "rests": False},
    ),
    "exact flight, rest": (lambda r: ideal(0.4 * r), vi.ExactFlight(), {}),
    "motor": (motor, vi.FixedStep(), {}),
}  # fmt: skip


@pytest.mark.parametrize("name", quick(CASES, "cycles that an impact ends"))
def test_backends_agree(name):
    make, method, options = CASES[name]

    def lane(ratio):
        scene = make(ratio)
        return vi.simulate(scene, scene.start(Y=0.1, V=0.2), 12, method=method, **options)

    ratios = jnp.linspace(0.7, 1.3, 11)
    runs = []
    for backend in ("auto", "xla"):
        with vi.backend(backend):
            runs.append(jax.jit(jax.vmap(lane))(ratios))
    fast, slow = runs
    assert bool(jnp.all(fast.successful))
    np.testing.assert_array_equal(fast.impacts, slow.impacts)
    # Rounding changes the steps of an adaptive method, and can add one to a thousand in a chatter.
    if not isinstance(method, vi.Adaptive):
        np.testing.assert_allclose(fast.steps, slow.steps, rtol=2e-3 if "rest" in name else 0)
    if name == "cycles that an impact ends":  # each impact multiplies the speed by k
        first = np.sqrt(0.2**2 + 2 * 0.9)
        fall = first * np.outer(0.6 * ratios, np.ones(12)).cumprod(axis=1)
        np.testing.assert_allclose(fast.sections.V[:, 1:], -fall, rtol=1e-9)
    # The motion amplifies rounding errors, by at most 1e3 in these lanes. An adaptive method also
    # changes its steps, so its results differ within the tolerance.
    close = 1e-9 if isinstance(method, vi.Adaptive) else 1e-12
    for a, b in zip(jax.tree.leaves(fast), jax.tree.leaves(slow), strict=True):
        if a.dtype == jnp.float64:
            np.testing.assert_allclose(a, b, rtol=0, atol=close)
