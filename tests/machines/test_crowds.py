"""Ten thousand random machines of each kind: all end, none passes its stop, gains at a contact or
fails without a reason. Derivatives of a hundred of each by all their numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.machine.numbers import with_leaf

from differences import quick

LANES, CYCLES = 10_000, 12
M = vi.machines

# Ranges of the numbers drawn, and of the start's. A rotor of more coupling often stalls.
PAPER = {"oscillator.damping_ratio": (0.0, 0.5), "stops.0.gap": (-1.0, 3.0),
         "stops.0.restitution": (0.0, 1.0)}  # fmt: skip
BELOW = {"Y": (-3.0, -1.0), "V": (-3.0, 3.0)}
KINDS = {
    "paper": (vi.Scene.ideal(frequency_ratio=0.9), {"drive.frequency_ratio": (0.1, 3.0), **PAPER},
              BELOW),
    "motor": (vi.Parameters().scene(crank="slider"),
              {"drive.strength": (0.3, 10.0), "drive.control": (0.5, 2.0),
               "drive.coupling": (0.0, 0.05), "drive.slider_inertia": (0.0, 0.2),
               "crank.ratio": (0.1, 0.9), **PAPER}, {"W": (0.5, 2.0), **BELOW}),
    "ball": (M.BouncingBall(), {"acceleration": (0.1, 5.0), "restitution": (0.0, 1.0)},
             {"height": (0.0, 5.0), "speed": (-3.0, 3.0)}),
    "pair": (M.ImpactPair(), {"half_gap": (0.2, 6.0), "restitution": (0.0, 1.0)},
             {"place": (-0.2, 0.2), "speed": (-3.0, 3.0)}),
    "free pair": (M.ImpactPair(mass_ratio=0.2),
                  {"half_gap": (0.2, 6.0), "restitution": (0.0, 1.0), "mass_ratio": (0.01, 2.0),
                   "damping_ratio": (0.0, 0.5), "force": (0.0, 2.0), "frequency": (0.3, 3.0)},
                  {"place": (-0.2, 0.2), "speed": (-3.0, 3.0)}),
    "duffing": (M.Duffing(), {"cubic": (0.0, 3.0), "amplitude": (0.0, 3.0), "gap": (0.1, 2.0),
                              "restitution": (0.0, 1.0), "damping": (0.0, 0.5)},
                {"Y": (-0.1, 0.1), "V": (-3.0, 3.0)}),
    "valve": (M.ReliefValve(), {"flow_rate": (0.2, 8.0), "restitution": (0.0, 1.0),
                                "damping": (0.5, 3.0)},
              {"lift": (0.0, 3.0), "speed": (-2.0, 2.0), "pressure": (5.0, 20.0)}),
    "capsule": (M.Capsule(), {"amplitude": (0.0, 4.0), "frequency": (0.3, 3.0), "gap": (0.0, 1.0),
                              "mass_ratio": (0.5, 10.0), "restitution": (0.0, 1.0),
                              "friction": (0.0, 4.0), "static_ratio": (1.0, 2.0)},
                {"place": (-1.0, 0.0), "speed": (-2.0, 2.0)}),
    "rotor": (M.UnbalancedRotor(gap=1.0), {"strength": (0.05, 3.0), "control": (0.3, 3.0),
                                           "coupling": (0.0, 0.2), "damping_ratio": (0.0, 0.5),
                                           "gap": (0.2, 3.0), "restitution": (0.0, 1.0)},
              {"Y": (-0.2, 0.2), "V": (-2.0, 2.0)}),
}  # fmt: skip


def crowd(name, lanes):
    """A machine, and so many sets of its numbers and starts."""
    machine, numbers, begin = KINDS[name]
    rng = np.random.default_rng(sum(map(ord, name)))
    return machine, *(
        {key: jnp.asarray(rng.uniform(*ends, lanes)) for key, ends in ranges.items()}
        for ranges in (numbers, begin)
    )


def changed(machine, numbers):
    for name, value in numbers.items():
        machine = with_leaf(machine, name, value)
    return machine


@pytest.mark.parametrize("name", quick(KINDS, "motor"))
def test_a_crowd(name):
    machine, drawn, starts = crowd(name, LANES)

    def one(drawn, starts):
        scene = changed(machine, drawn)
        run = vi.simulate(scene, scene.start(**starts), CYCLES)
        stops = [stop for stop in scene.stops if stop.coordinate == 0]
        depth = [
            jnp.where(stop.sign > 0, run.y_max - stop.gap, -run.y_min - stop.gap).max()
            for stop in stops
        ]
        return run, jnp.stack(depth).max(), 1 + jnp.stack([abs(stop.gap) for stop in stops]).max()

    run, depth, size = vi.jit(jax.vmap(one))(drawn, starts)
    good = np.asarray(run.successful)
    assert good.mean() > 0.95, np.unique(np.asarray(run.result._value), return_counts=True)
    for leaf in jax.tree.leaves((run.sections, run.y_max, run.y_min, run.impact_energy)):
        assert np.isfinite(np.asarray(leaf)[good]).all()
    assert (np.asarray(depth / size)[good] < 1e-12).all()
    assert (np.asarray(run.impact_energy)[good] >= 0).all()
    assert int(np.asarray(run.impacts)[good].sum()) > LANES
    # Each that failed has its reason, and what came before it.
    assert (np.asarray(run.result._value)[~good] > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["free pair", "capsule"])
def test_derivatives_of_a_crowd(name):
    """By every number and every part of the start: forward beside central differences where two
    steps of these agree with each other, and reverse beside forward."""
    lanes, step = 100, 1e-5
    machine, drawn, starts = crowd(name, lanes)
    at = jnp.stack([*drawn.values(), *starts.values()], axis=1)

    def last(x):
        values = dict(zip((*drawn, *starts), x, strict=True))
        scene = changed(machine, {key: values[key] for key in drawn})
        start = scene.start(**{key: values[key] for key in starts})
        run = vi.simulate(scene, start, 2, method="reference", record="sections")
        return jnp.stack(jax.tree.leaves(run.last)), (run.impacts, run.successful)

    jacobian = vi.jit(jax.vmap(jax.jacfwd(last, has_aux=True)))
    forward, (impacts, good) = jacobian(at)
    moves = jnp.eye(at.shape[1])
    places = jnp.array([step, -step, step / 2, -step / 2])[:, None, None, None]
    moved, (counts, _) = vi.jit(jax.vmap(jax.vmap(jax.vmap(last))))(
        at + places * moves[:, None]
    )  # (4, numbers, lanes, states)
    wide, close = (moved[0] - moved[1]) / (2 * step), (moved[2] - moved[3]) / step
    slope = np.moveaxis(np.asarray(4 * close - wide) / 3, 0, -1)
    size = 1 + np.abs(slope).max(axis=(1, 2))
    doubt = np.abs(np.moveaxis(np.asarray(close - wide), 0, -1)).max(axis=(1, 2)) / size
    same = np.asarray((counts == impacts).all(axis=(0, 1, 3)) & good)
    sure = same & (doubt < 1e-6)
    assert sure.sum() >= 60 and int(np.asarray(impacts)[sure].sum()) >= 30
    wrong = np.abs(np.asarray(forward) - slope).max(axis=(1, 2)) / size
    assert (wrong[sure] < 1e-6).all()

    # The two sum in different orders, so a lane near a graze, whose derivative changes by 1e-7 as
    # the input does by its last bit, agrees no better. Each lane is held to what such bits do to
    # its own derivatives (worst of 700 lanes: 3.1 times that of six moves).
    weights = jnp.arange(1.0, forward.shape[1] + 1)
    backward = np.asarray(vi.jit(jax.vmap(jax.grad(lambda x: weights @ last(x)[0])))(at))
    wanted = np.asarray(jnp.einsum("s,lsn->ln", weights, forward))
    scale = 1 + np.abs(wanted).max(axis=1)
    rng = np.random.default_rng(0)
    bits = [1 + np.finfo(float).eps * rng.choice([-1, 1], at.shape) for _ in range(6)]
    near = [np.einsum("s,lsn->ln", weights, jacobian(at * move)[0]) for move in bits]
    doubt = np.max([np.abs(other - wanted).max(axis=1) for other in near], axis=0) / scale
    apart = np.abs(backward - wanted).max(axis=1) / scale
    good = np.asarray(good)
    assert (doubt[good] < 1e-12).mean() > 0.8
    shares = (apart / (1e-12 + 10 * doubt))[good]
    assert (shares <= 1).all(), shares.max()
