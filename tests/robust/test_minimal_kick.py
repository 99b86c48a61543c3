"""The minimal kick, compared with brute force, bisection and SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.robust import _minimal_kick

from belts import Belt

pytestmark = pytest.mark.slow

# This scene has two stable motions of period 4π, with one impact and with two.
SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.02)


@pytest.fixture(scope="module")
def motions():
    found = [
        vi.find_orbit(SCENE, SCENE.start(Y=Y, V=V), 2) for Y, V in ((1.283, 1.007), (1.528, 1.314))
    ]
    assert [int(orbit.impacts) for orbit in found] == [1, 2]
    return found


@pytest.fixture(scope="module")
def result(motions):
    return vi.minimal_kick(SCENE, motions[0])


@pytest.fixture(scope="module")
def two_impacts():
    """Return a function of many starts: whether they settle on the motion with two impacts."""

    def one(row):
        run = vi.simulate(SCENE, SCENE.start(Y=row[0], V=row[1]), 2, settle=200)
        return jnp.sum(run.impacts) == 2

    return vi.jit(jax.vmap(one))


def row_of(state):
    return np.array([float(state.Y), float(state.V)])


def test_the_minimal_kick_agrees_with_bisection_along_it(motions, result, two_impacts):
    begin, there = row_of(motions[0].state), row_of(result.start)
    size = np.linalg.norm(there - begin)
    assert float(result.norm) == pytest.approx(size, rel=1e-12)
    np.testing.assert_allclose([result.kick["Y"], result.kick["V"]], there - begin, atol=1e-14)
    low, high = 0.0, 2.0
    for _ in range(5):
        parts = np.linspace(low, high, 256)
        first = int(np.argmax(np.asarray(two_impacts(begin + parts[:, None] * (there - begin)))))
        low, high = parts[first - 1], parts[first]
    assert high == pytest.approx(1, abs=1e-9)
    assert result.exact and result.confirmed and float(result.residual) < 1e-9
    assert int(result.settles.impacts) == 2 and bool(result.settles.stable)
    assert result.lanes < 42_000  # 1 % of a map with 2,048² starts


def test_no_smaller_kick_leads_elsewhere(motions, result, two_impacts):
    """Check all directions, and many close to that of the kick. A slightly harder kick escapes."""
    begin, angle = row_of(motions[0].state), np.arctan2(result.kick["V"], result.kick["Y"])
    angles = np.concatenate(
        [np.linspace(0, 2 * np.pi, 8192), angle + np.linspace(-0.01, 0.01, 512)]
    )
    around = np.stack([np.cos(angles), np.sin(angles)], axis=1) * float(result.norm)
    for size in (1 - 1e-7, 0.7, 0.3, 0.1):
        assert not np.asarray(two_impacts(begin + size * around)).any()
    assert np.asarray(two_impacts(begin + (1 + 1e-7) * around)).any()


def test_the_edge_state_is_the_saddle(motions, result):
    saddle = vi.find_orbit(SCENE, SCENE.start(Y=1.26, V=1.086), 2)
    assert saddle.successful and not saddle.stable
    tracked = vi.edge_state(SCENE, motions[1], motions[0])
    sections = np.array([saddle.sections.Y, saddle.sections.V]).T
    for edge in (result.edge, tracked):
        assert edge.kind == "saddle"
        assert np.abs(sections - row_of(edge.orbit.state)).max(axis=1).min() < 1e-8


def test_a_weighted_norm(motions, two_impacts, monkeypatch):
    """No kick within the ellipse of the weighted norm leads elsewhere. A kick that two rays find is
    listed once."""
    names, best = ["V", "Y"], _minimal_kick.nearest_first
    monkeypatch.setattr(_minimal_kick, "nearest_first", lambda *arguments: 2 * best(*arguments))
    result = vi.minimal_kick(SCENE, motions[0], components=names, weights={"V": 3.0}, candidates=1)
    assert sorted(result.kick) == ["V", "Y"] and result.exact and result.confirmed
    assert not result.others
    kick = np.array([float(result.kick["Y"]), 3 * float(result.kick["V"])])
    assert float(result.norm) == pytest.approx(np.linalg.norm(kick))
    angle = np.arctan2(*kick[::-1]) + np.append(
        np.linspace(0, 2 * np.pi, 4096), np.linspace(-0.01, 0.01, 512)
    )
    around = np.stack([np.cos(angle), np.sin(angle) / 3], axis=1) * float(result.norm)
    begin = row_of(motions[0].state)
    for size in (1 - 1e-7, 0.5):
        assert not np.asarray(two_impacts(begin + size * around)).any()
    assert np.asarray(two_impacts(begin + (1 + 1e-7) * around)).any()


def test_invalid_arguments_raise(motions, result):
    ask = vi.minimal_kick
    with pytest.raises(ValueError, match="`orbit` must be a stable orbit"):
        ask(SCENE, result.edge.orbit)
    with pytest.raises(ValueError, match=r"`components` must name .* but names 'W'"):
        ask(SCENE, motions[0], components=["W"])
    with pytest.raises(TypeError, match="`components` must be a list"):
        ask(SCENE, motions[0], components="V")
    with pytest.raises(ValueError, match=r"weights\['V'\]` must be"):
        ask(SCENE, motions[0], weights={"V": 0.0})
    with pytest.raises(ValueError, match="`bounds` must hold the state"):
        ask(SCENE, motions[0], bounds={"Y": (-1.0, 1.0)})
    with pytest.raises(ValueError, match="No kick leads elsewhere"):
        ask(SCENE, motions[0], largest=0.5 * float(result.norm))
    with pytest.raises(ValueError, match="must settle on different motions"):
        vi.edge_state(SCENE, motions[0], motions[0])


def moved_to_section(motion, number, of):
    """Return the motion on a section at the crank angle 2π number/of."""
    samples = vi.simulate(SCENE, motion.state, 2, samples=of, record="sections").samples.state
    there = SCENE.at_section(number % of * 2 * np.pi / of)
    return vi.find_orbit(there, there.start(Y=samples.Y[number], V=samples.V[number]), 2)


def test_a_kick_at_a_phase_equals_that_on_a_section_there(motions):
    here = moved_to_section(motions[0], 6, 4)
    given = {"components": ["V"], "candidates": 1, "progress": False}
    there = vi.minimal_kick(here.machine, here, **given)
    found = vi.minimal_kick(SCENE, motions[0], cycle=1, phase=np.pi, **given)
    assert found.exact and found.confirmed and found.edge.kind == "saddle"
    assert (found.cycle, float(found.phase)) == (1, np.pi)
    assert float(found.kick["V"]) == pytest.approx(float(there.kick["V"]), abs=1e-10)


def test_invalid_phases_raise(motions):
    ask = vi.minimal_kick
    with pytest.raises(TypeError, match="`phase` must be"):
        ask(SCENE, motions[0], phase="best")
    with pytest.raises(ValueError, match=r"`phase` must be less than the 6\.28318531"):
        ask(SCENE, motions[0], phase=7.0)
    rest = vi.OscillatorState(jnp.asarray(0.5 + 0.5 * np.exp(-3.0)), jnp.asarray(0.0))
    with pytest.raises(ValueError, match="`phase` must be 0 for an equilibrium"):
        ask(Belt(), rest, phase=1.0)


@pytest.mark.exhaustive
def test_the_minimal_kick_of_steady_sliding():
    """The kick leads to stick-slip, across the unstable cycle of sliding."""
    rest = 0.5 + 0.5 * np.exp(-3.0)
    result = vi.minimal_kick(
        Belt(), vi.OscillatorState(jnp.asarray(rest), jnp.asarray(0.0)), directions=64
    )
    # Smallest distance to that cycle by SciPy, which finds it backward in time.
    assert float(result.norm) == pytest.approx(1.17393040, abs=1e-8)
    np.testing.assert_allclose(row_of(result.start), [-0.464548, 0.631758], atol=1e-6)
    assert result.exact and result.confirmed
    assert result.edge.kind == "saddle" and bool(result.settles.stable)


class Between(vi.AbstractMachine):
    """x goes to 1 or -1, where an oscillator decays to rest. On the boundary x = 0 it is Ueda's
    driven oscillator."""

    push: jax.Array | float = 1.0
    cycle = 2 * np.pi

    def field(self, s, z):
        calm = z.x**2
        pushed = self.push * jnp.cos(s) * (1 - calm) - z.Y**3 - calm * z.Y
        return dict(Y=z.V, V=pushed - (0.05 + 0.5 * calm) * z.V, x=0.1 * (z.x - z.x**3))


HOME = vi.State(Y=0.0, V=0.0, x=1.0)


def test_a_chaotic_edge_state():
    """Ueda's oscillator with amplitude 7.5 is chaotic."""
    edge = vi.edge_state(Between(push=7.5), HOME, vi.State(Y=1.0, V=0.5, x=-0.5), rounds=24)
    assert edge.orbit is None and edge.kind == "chaotic"
    assert np.abs(np.asarray(edge.sections.x)).max() < 2e-5
