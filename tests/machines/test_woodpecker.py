"""The woodpecker toy: its multipliers, its range and its sketch. The script `woodpecker` of
`experiments/validated` has the events of its cycle."""

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.machine import is_in_range, section_in

matplotlib.use("Agg")
WOODPECKER = vi.machines.Woodpecker
CLOSE = vi.Adaptive(rtol=1e-12)

# Velocities at the start of the cycle for Glocker's parameters, integrated from event to event with
# more digits. Impacts dissipate LOST of the energy of the weight, by SciPy's DOP853 at 1e-13.
SPEED, BIRD_RATE, LOST = -0.33947862236, -7.46209464263, 1.245143533e-4
MULTIPLIER = -0.8391556

# Lanes: the cycle, and nearby starts for differences of its map.
STEP = 1e-5
OFFSETS = ((0, 0), (STEP, 0), (-STEP, 0), (0, 30 * STEP), (0, -30 * STEP))


@pytest.fixture(scope="module")
def run():
    toy = WOODPECKER(friction=0.3)
    one = vi.jit(jax.vmap(lambda x: vi.simulate(toy, x, method=CLOSE)))
    v = [dict(height=SPEED + a, bird_angle=BIRD_RATE + b) for a, b in OFFSETS]
    starts = [toy.at(**vars(toy.start()) | {"v": x}) for x in v]
    found = one(jax.tree.map(lambda *x: jnp.stack(x), *starts))
    # The motion continues with its sleeve on the pole, except for the velocity left by rounding.
    assert bool(found.successful.all()) and bool(one(found.last).successful.all())
    return found


@pytest.mark.slow
def test_multipliers_of_the_cycle(run):
    """Differences of the map of the two free numbers of a start on the lower edge."""
    ends = np.stack([run.last.v.height, run.last.v.bird_angle], -1)
    np.testing.assert_allclose(ends[0], [SPEED, BIRD_RATE], rtol=1e-8)
    assert float(run.impact_energy[0, 0]) == pytest.approx(LOST, rel=1e-7)
    slopes = [(ends[i] - ends[i + 1]) / (2 * h) for i, h in ((1, STEP), (3, 30 * STEP))]
    found = np.sort(np.linalg.eigvals(np.transpose(slopes)).real)
    np.testing.assert_allclose(found, [MULTIPLIER, 0], atol=1e-5)


def test_range_of_the_sleeve_radius():
    toy = eqx.tree_at(lambda m: m.sleeve_radius, WOODPECKER(), jnp.asarray(0.002))
    assert not bool(is_in_range(toy, toy.start()))
    assert bool(is_in_range(WOODPECKER(), WOODPECKER().start()))


def test_sketch_touches_the_pole_at_contacts():
    """Sleeve and beak touch the pole at the angles where the machine has contact."""
    toy = WOODPECKER()
    half = float(toy.pole_radius)

    def corners(bird, sleeve):
        ax = vi.plot_sketch(toy, toy.at(bird_angle=bird, sleeve_angle=sleeve))
        return [patch.get_xy() for patch in ax.patches]

    jam, peck = float(toy.play / toy.sleeve_height), float(toy.reach / toy.beak_height)
    open_, shut = corners(0.0, 0.0), corners(peck, -jam)
    assert len(open_) == len(shut) == 6  # the pole, two walls of the sleeve, beak, body, head

    def walls(shapes):
        return [x for x in shapes if len(x) == 5][1:3]

    assert min(np.abs(x[:, 0]).min() for x in walls(open_)) == pytest.approx(half + float(toy.play))
    assert min(np.abs(x[:, 0]).min() for x in walls(shut)) == pytest.approx(half, rel=0.02)
    beaks = [next(x for x in y if len(x) == 4)[0, 0] for y in (open_, shut)]
    assert beaks[0] == pytest.approx(half + float(toy.reach))
    # The gap of the beak is linear in the bird's angle.
    assert beaks[1] == pytest.approx(half, rel=0.1)
    matplotlib.pyplot.close("all")


def test_height_restarts_with_each_cycle_but_not_at_equal_times():
    toy, state = WOODPECKER(), WOODPECKER().at(height=-0.02)
    assert float(toy.renewed(state).height) == 0.0
    by_time = toy.observed_every(0.1)
    assert section_in(by_time, state) is None and by_time.renewed(state) is state
