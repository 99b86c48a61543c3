"""Kicks at other moments than the section, and the worst of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from belts import Belt, Observed

SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.02)
BLOW = {"components": ["V"], "candidates": 1, "progress": False}


@pytest.fixture(scope="module")
def motion():
    return vi.find_orbit(SCENE, SCENE.start(Y=1.283, V=1.007), 2)


def seen_from(motion, number, of):
    """The motion on a section moved by so many parts of a turn of the crank."""
    samples = vi.simulate(SCENE, motion.state, 2, samples=of, record="sections").samples.state
    there = SCENE.at_section(number % of * 2 * np.pi / of)
    return vi.find_orbit(there, there.start(Y=samples.Y[number], V=samples.V[number]), 2)


@pytest.mark.slow
def test_a_kick_at_a_phase_is_that_on_a_section_there(motion):
    for number, components in ((1, ["V"]), (6, ["Y", "V"])):
        here = seen_from(motion, number, 4)
        there = vi.minimal_kick(here.machine, here, **{**BLOW, "components": components})
        at = {"cycle": number // 4, "phase": number % 4 * np.pi / 2}
        found = vi.minimal_kick(SCENE, motion, **at, **{**BLOW, "components": components})
        assert found.exact and found.confirmed and found.edge.kind == "saddle"
        assert (found.cycle, float(found.phase)) == (at["cycle"], at["phase"])
        for name in components:
            assert float(found.kick[name]) == pytest.approx(float(there.kick[name]), abs=1e-10)


@pytest.mark.slow
def test_the_worst_phase_beside_all_phases(motion):
    """Blows of 64 sizes at 96 phases of the two turns, each simulated on a section of its own."""
    found = vi.minimal_kick(SCENE, motion, phase="worst", phases=8, **BLOW)
    assert found.exact and found.confirmed
    assert f"{float(found.phase):.9g} after the section of cycle 1" in str(found)
    run = vi.simulate(SCENE, motion.state, 2, samples=48, record="sections")
    states = jax.tree.map(lambda x: x[:96], run.samples.state)
    angles = np.tile(2 * np.pi * np.arange(48) / 48, 2)
    sizes = np.linspace(0, 0.07, 64)[1:]
    blows = np.concatenate([-sizes, sizes])

    def elsewhere(angle, state, blow):
        scene = SCENE.at_section(angle)
        run = vi.simulate(scene, scene.start(Y=state.Y, V=state.V + blow), 2, settle=200)
        return jnp.sum(run.impacts) == 2

    over_blows = jax.vmap(elsewhere, in_axes=(None, None, 0))
    other = np.asarray(vi.jit(jax.vmap(over_blows, in_axes=(0, 0, None)))(angles, states, blows))
    least = np.min(np.where(other, np.abs(blows), np.inf), axis=1)
    place, step = int(np.argmin(least)), sizes[1] - sizes[0]
    assert 0 <= least.min() - float(found.norm) < 2 * step
    clock = 2 * np.pi * found.cycle + float(found.phase)
    assert abs(clock - 2 * np.pi * place / 48) < 2 * np.pi / 8


class Later(vi.machines.Duffing):
    """The same oscillator, whose cycle begins later in its drive's."""

    later: jax.Array | float = 0.0

    def field(self, s, state):
        return super().field(s + self.later, state)


@pytest.mark.exhaustive
def test_a_machine_of_ones_own_is_kicked_at_a_phase():
    """One that is driven, whose section cannot be moved: beside the same with another origin."""
    numbers = {"amplitude": 0.2, "damping": 0.15, "stiffness": -1.0, "cubic": 1.0, "gap": 100.0}
    first, then = Later(**numbers), Later(later=jnp.asarray(2.0), **numbers)
    motion = vi.find_orbit(first, first.start(Y=1.0, V=0.2), 1)
    found = vi.minimal_kick(first, motion, phase=2.0, **BLOW)
    state = vi.OscillatorState(found.start.Y, found.start.V - found.kick["V"])
    there = vi.find_orbit(then, state, 1)
    np.testing.assert_allclose([there.state.Y, there.state.V], [state.Y, state.V], atol=1e-9)
    other = vi.minimal_kick(then, there, **BLOW)
    assert float(found.norm) == pytest.approx(float(other.norm), abs=1e-9)


@pytest.mark.exhaustive
def test_the_worst_moment_of_a_machine_without_a_drive():
    """Kicks that stop sticking and slipping. The least is the distance between its cycle and the
    unstable one of sliding, by SciPy."""
    belt = Observed(jnp.asarray(1.5))
    motion = vi.find_orbit(belt, belt.start(Y=-1.2), 1, throw=True)
    found = vi.minimal_kick(
        belt, motion, phase="worst", candidates=1, directions=32, progress=False
    )
    assert found.confirmed and float(found.norm) == pytest.approx(0.250943, abs=1e-5)


@pytest.mark.slow
def test_phases_that_cannot_be_asked(motion):
    ask = vi.minimal_kick
    with pytest.raises(ValueError, match="`phase` must be a number or \"worst\", but got 'best'"):
        ask(SCENE, motion, phase="best")
    with pytest.raises(ValueError, match="`cycle` must be left out"):
        ask(SCENE, motion, phase="worst", cycle=1)
    with pytest.raises(ValueError, match=r"`phase` must be less than the 6\.28318531"):
        ask(SCENE, motion, phase=7.0)
    rest = vi.OscillatorState(jnp.asarray(0.5 + 0.5 * np.exp(-3.0)), jnp.asarray(0.0))
    with pytest.raises(ValueError, match="`phase` must be 0 for an equilibrium"):
        ask(Belt(), rest, phase=1.0)
