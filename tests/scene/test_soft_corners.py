"""Compliant stops at the corners of their law."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi


def scene(**law):
    return vi.Scene(
        oscillator=vi.Oscillator(0.02),
        drive=vi.IdealDrive(0.7),
        soft_stops=(vi.SoftStop(0.3, 100.0, **law),),
    )


def test_without_damping_nothing_is_to_be_let_go_of():
    """The force falls to zero just where the body comes out."""
    places = jnp.linspace(-1.0, 0.3, 200)
    runs = []
    for adhesive in (False, True):
        machine = scene(adhesive=adhesive)

        def one(place, machine=machine):
            start = machine.start(Y=place, V=0.4)
            return vi.simulate(machine, start, 8, method=vi.Adaptive(rtol=1e-12))

        runs.append(vi.jit(jax.vmap(one))(places))
    assert all(bool(run.successful.all()) for run in runs)
    np.testing.assert_allclose(runs[0].last.Y, runs[1].last.Y, atol=1e-9)


def test_a_force_without_a_series_is_refused_by_taylor():
    machine = scene(exponent=1.5)
    with pytest.raises(ValueError, match="no power series"):
        vi.simulate(machine, machine.start(), 1, method=vi.Taylor())
    straight = scene()
    run = vi.simulate(straight, straight.start(), 1, method=vi.Taylor())
    assert bool(run.successful)
