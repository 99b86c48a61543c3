"""Kicks at other moments than the section."""

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from belts import Belt

SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.02)
BLOW = {"components": ["V"], "candidates": 1, "progress": False}


@pytest.fixture(scope="module")
def motion():
    return vi.find_orbit(SCENE, SCENE.start(Y=1.283, V=1.007), 2)


def moved_to_section(motion, number, of):
    """Return the motion on a section at the crank angle 2π number/of."""
    samples = vi.simulate(SCENE, motion.state, 2, samples=of, record="sections").samples.state
    there = SCENE.at_section(number % of * 2 * np.pi / of)
    return vi.find_orbit(there, there.start(Y=samples.Y[number], V=samples.V[number]), 2)


@pytest.mark.slow
def test_a_kick_at_a_phase_equals_that_on_a_section_there(motion):
    for number, components in ((1, ["V"]), (6, ["Y", "V"])):
        here = moved_to_section(motion, number, 4)
        there = vi.minimal_kick(here.machine, here, **{**BLOW, "components": components})
        at = {"cycle": number // 4, "phase": number % 4 * np.pi / 2}
        found = vi.minimal_kick(SCENE, motion, **at, **{**BLOW, "components": components})
        assert found.exact and found.confirmed and found.edge.kind == "saddle"
        assert (found.cycle, float(found.phase)) == (at["cycle"], at["phase"])
        for name in components:
            assert float(found.kick[name]) == pytest.approx(float(there.kick[name]), abs=1e-10)


@pytest.mark.slow
def test_invalid_phases_raise(motion):
    ask = vi.minimal_kick
    with pytest.raises(TypeError, match="`phase` must be"):
        ask(SCENE, motion, phase="best")
    with pytest.raises(ValueError, match=r"`phase` must be less than the 6\.28318531"):
        ask(SCENE, motion, phase=7.0)
    rest = vi.OscillatorState(jnp.asarray(0.5 + 0.5 * np.exp(-3.0)), jnp.asarray(0.0))
    with pytest.raises(ValueError, match="`phase` must be 0 for an equilibrium"):
        ask(Belt(), rest, phase=1.0)
    belt, coarse = Belt(jnp.asarray(1.5)), vi.FixedStep(steps_per_cycle=8)
    sticks = vi.find_orbit(belt, belt.start(Y=-1.2), 1, method=coarse, throw=True)
    runs = (vi.simulate(belt, sticks.state, 1, **by) for by in ({"method": coarse}, {}))
    length, other = (f"{float(run.duration[0]):.9g}" for run in runs)
    with pytest.raises(ValueError, match="`phase` must be less than the " + length) as refused:
        ask(belt, sticks, phase=100.0, method=coarse)
    assert other != length and other not in str(refused.value)
