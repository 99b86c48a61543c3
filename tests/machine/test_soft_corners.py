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


@pytest.mark.slow
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


@pytest.mark.parametrize(("prestress", "exponent"), [(None, 1.5), (0.2, 0.5)])
def test_how_a_motion_changes_where_it_begins_to_graze(prestress, exponent):
    """By the depth to the power 3/2 where the force begins from zero (Kundu et al., Physica D 241,
    2012), and by its root where the stop is prestressed."""
    law = {"damping": 0.3, "prestress": prestress}
    free = vi.Scene(oscillator=vi.Oscillator(0.05), drive=vi.IdealDrive(0.7))
    start, method = free.start(V=-1.0), vi.Adaptive(rtol=1e-13, atol=1e-15)
    beside = vi.simulate(free, start, 2, method=method)
    top, depth = beside.y_max.max(), jnp.logspace(-7, -5, 9)

    def changed(depth):
        stop = vi.SoftStop(top - depth, 30.0, **law)
        run = vi.simulate(
            vi.Scene(free.oscillator, free.drive, soft_stops=(stop,)), start, 2, method=method
        )
        return jnp.hypot(run.last.Y - beside.last.Y, run.last.V - beside.last.V)

    changes = vi.jit(jax.vmap(changed))(depth)
    assert np.polyfit(np.log(depth), np.log(changes), 1)[0] == pytest.approx(exponent, abs=0.005)
