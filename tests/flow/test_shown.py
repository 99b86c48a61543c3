"""Representations as text: numbers, units and names."""

import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.machine import by_name, unit_of

M = vi.machines
MACHINES = [
    vi.Scene.ideal(frequency_ratio=0.9, gap=1.25, damping_ratio=0.0625),
    vi.Parameters().scene(crank="slider"),
    M.UnbalancedRotor(gap=1.0), M.Woodpecker(), vi.SoftStop(1.5, stiffness=30.0), vi.Parameters(),
]  # fmt: skip
SCENE = MACHINES[0]


@pytest.mark.parametrize("thing", MACHINES, ids=lambda x: type(x).__name__)
def test_numbers_are_shown_with_their_units(thing):
    shown = [thing, thing.start()] if isinstance(thing, vi.AbstractMachine) else [thing]
    for x in shown:
        units = getattr(x, "units", {})
        text = repr(x)
        assert str(x) == text and text.startswith(f"{type(x).__name__}(") and "f64[" not in text
        for name, number in by_name(x).items():
            unit = unit_of(units, name)
            told = f"{float(number):.9g}{'' if unit in ('', '1') else ' ' + unit}"
            assert f"{name.split('.')[-1]}={told}" in text


def test_runs_and_exponents_have_text():
    run = vi.simulate(SCENE, SCENE.start(), 5)
    assert repr(run) == str(run) and f"V = {float(run.last.V):.9g} a ω" in repr(run)
    assert f"{float(run.y_max[-1]):.6g}] a" in repr(run)
    both = jax.tree.map(lambda x: jnp.stack([x, x]), run)
    assert repr(both) == "Run of 2 lanes (2,), 2 successful"
    rates = vi.Lyapunov(
        jnp.asarray([0.1, -0.3]), jnp.asarray([0.2, -0.6]), jnp.asarray(0.01), run.last,
        run.result, unit="ω",
    )  # fmt: skip
    assert "0.1, -0.3 ω" in repr(rates)
    more = jax.tree.map(lambda x: jnp.stack([x, 2 * x]), rates)
    assert "lanes (2,), 2 successful; greatest: [0.1, 0.2] ω" in repr(more)


def test_reasons_print_their_names():
    def one(gap):
        scene = vi.Scene.ideal(frequency_ratio=0.9, gap=gap, damping_ratio=0.05)
        return vi.simulate(scene, scene.start(), 1).result

    found = jax.vmap(one)(jnp.asarray([1.0, -1.0]))
    assert str(found) == "RESULTS[successful, bad_start]"
    first = jax.tree.map(lambda x: x[0], found)
    assert repr(first) == repr(vi.RESULTS.successful) == "RESULTS.successful"
    assert str(pickle.loads(pickle.dumps(first))) == "RESULTS.successful"
    np.testing.assert_array_equal(found == vi.RESULTS.bad_start, [False, True])
    many = jax.tree.map(lambda x: jnp.tile(x, (20, 1)), found)
    assert str(many) == "RESULTS[20 bad_start, 20 successful; shape (20, 2)]"
    chosen = jax.jit(lambda x: vi.RESULTS.where(x, vi.RESULTS.stalled, vi.RESULTS.chatter))
    assert str(chosen(True)) == "RESULTS.stalled" and "chatter" in vi.RESULTS[chosen(False)]
    told = []
    jax.jit(lambda x: told.append(str(x)) or x)(first)
    assert told == ["RESULTS<traced>"] and isinstance(first, vi.RESULTS)
    assert str(vi.STABILITY.fold) == "STABILITY.fold"
