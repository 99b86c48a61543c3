"""Of the studies that fit machines to records."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi

from .closed_forms import XI, Expected


def identify() -> Expected:
    """From the Jacobian at the truth: the errors' correlation, and the noise."""
    truth = jnp.array([0.5, XI, 1.2, 0.0, 0.0])

    def positions(x):
        scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=x[0], gap=x[2], damping_ratio=x[1])
        run = vi.simulate(
            scene, scene.start(Y=x[3], V=x[4]), 10, method=vi.ExactFlight(), samples=32
        )
        assert run.samples is not None
        return run.samples.state.Y[1:]

    clean, jacobian = jax.jit(lambda x: (positions(x), jax.jacfwd(positions)(x)))(truth)
    covariance = np.linalg.inv(np.asarray(jacobian.T @ jacobian))
    size = np.sqrt(np.diag(covariance))
    return {
        "noise": (float(jnp.std(clean)) * 10**-1.5, 1e-9),
        "k and ξ: correlation": (float(covariance[0, 1] / size[0] / size[1]), 1e-6),
    }


def learned_laws() -> Expected:
    """The records' impacts, and how far noise puts them from the true motions."""

    class Oscillator(vi.AbstractMachine):
        amplitude: Any

        @property
        def contacts(self):
            return (vi.RigidStop(0.6, lambda v: 0.4 + 0.5 * jnp.exp(-v / 0.8)),)

        @property
        def cycle(self):
            return 2 * jnp.pi / 0.9

        def field(self, s, state):
            force = 0.7 * state.Y + 0.15 * state.Y**3
            shaking = self.amplitude * jnp.cos(0.9 * s)
            return vi.OscillatorState(state.V, shaking - 0.04 * state.V - force)

    first = jax.random.split(jax.random.key(2), 13)[0]
    a, b, c, d = jax.random.split(first, 4)
    amplitude = jax.random.uniform(a, (32,), minval=0.2, maxval=1.2)
    pulled = jax.random.uniform(b, (32,), minval=0.3, maxval=2.5)
    places, speeds = 0.05 * jax.random.normal(c, (32, 2)).T
    state = vi.OscillatorState(places - pulled, speeds)
    runs = vi.jit(jax.vmap(lambda x, y: vi.simulate(Oscillator(x), y, 3, samples=16)))(
        amplitude, state
    )
    noise = jax.random.normal(d, (32, 48))
    assert runs.samples is not None
    return {
        "impacts": (int(runs.impacts.sum()), 0),
        "misfit at the truth": (float(jnp.mean(noise**2)), 1e-9),
        "greatest depth": (float(jnp.min(runs.samples.state.Y)), 1e-8),
    }


def posterior() -> Expected:
    """The record of the picture, drawn from the prior, and what it can tell by its Jacobian."""
    key, _, _ = jax.random.split(jax.random.key(1), 3)
    truth = jax.random.normal(key, (200, 3))

    def run_of(z):
        k = 0.3 + 0.6 * jax.scipy.stats.norm.cdf(z[0])
        gap, xi = 1.2 * jnp.exp(0.1 * z[1]), 0.05 * jnp.exp(0.4 * z[2])
        scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=k, gap=gap, damping_ratio=xi)
        return vi.simulate(scene, scene.start(), 4, method=vi.ExactFlight(), samples=16)

    def positions(z):
        samples = run_of(z).samples
        assert samples is not None
        return samples.state.Y[1:]

    impacts = vi.jit(jax.vmap(lambda z: run_of(z).impacts.sum()))(truth)
    first = int(np.argmax(np.asarray(impacts) >= 3))
    slope = np.asarray(vi.jit(jax.jacfwd(positions))(truth[first]))
    return {
        "record of the picture": (first, 0),
        "its impacts": (int(impacts[first]), 0),
        "its least position": (float(positions(truth[first]).min()), 1e-9),
        "its information on z": (float(np.linalg.slogdet(slope.T @ slope)[1]), 1e-8),
    }
