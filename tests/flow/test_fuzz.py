"""Random scenes over the whole envelope: every lane ends, and none breaks a law of mechanics."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.flow.results import number_of

from differences import some

CYCLES = 5
PARTS = ("zeta", "xi", "k", "gap", "room", "Y", "V", "W", "tau0", "eps", "mu", "ratio")


class Flow(eqx.Module):
    """Position, velocity, and the work done on the body since the start."""

    Y: jax.Array
    V: jax.Array
    E: jax.Array


class Budget(vi.AbstractMachine):
    """The ideally driven oscillator in time, with its energy on the books."""

    zeta: jax.Array
    xi: jax.Array
    stops: tuple[vi.RigidStop, ...]

    @property
    def cycle(self):
        return 2 * jnp.pi / self.zeta

    def field(self, s, state):
        drive = jnp.cos(self.zeta * s)
        power = state.V * drive - 2 * self.xi * state.V**2
        return Flow(state.V, drive - state.Y - 2 * self.xi * state.V, power)

    def step_limit(self, s, state):
        return 0.4 * jnp.pi / jnp.maximum(1.0, self.zeta)

    def relaxation(self, s, state):
        return 1 / jnp.maximum(2 * self.xi, 1e-6)


def envelope(lanes, seed):
    """Parameters by name: corners of every kind among ordinary numbers."""
    rng = np.random.default_rng(seed)

    def mixed(ordinary, *corners):
        x = ordinary.copy()
        for share, corner in corners:
            at = rng.random(lanes) < share
            x[at] = np.broadcast_to(corner, lanes)[at]
        return x

    def decades(low, high):
        return 10 ** rng.uniform(low, high, lanes)

    zeta = mixed(decades(-1, 1), (0.2, decades(-2, 2)), (0.1, 1.0))
    xi = mixed(decades(-4, 0), (0.2, 0.0), (0.05, 1.0), (0.1, decades(0, 1)))
    k = mixed(rng.uniform(0, 1, lanes), (0.1, 0.0), (0.1, 1.0), (0.05, 0.999))
    gap = mixed(
        rng.uniform(-1, 3, lanes), (0.1, 0.0), (0.05, -1.5), (0.05, 1.0), (0.05, decades(2, 8))
    )
    room = mixed(rng.uniform(0.5, 4, lanes), (0.2, decades(-6, 0)))
    Y = gap - mixed(rng.uniform(0, 3, lanes), (0.3, 0.0)) * np.minimum(room, 1.0) / 3
    V = mixed(rng.uniform(-4, 4, lanes), (0.2, 0.0))
    W = mixed(rng.uniform(0.1, 3, lanes), (0.1, decades(-3, 0)))
    tau0 = mixed(decades(-2, 1), (0.1, 0.0), (0.05, decades(1, 3)))
    eps = mixed(decades(-3, 0), (0.1, 0.0), (0.1, decades(0, 1)))
    mu = mixed(decades(-3, 0), (0.2, 0.0))
    ratio = mixed(rng.uniform(0.1, 0.9, lanes), (0.1, 0.99))
    names = locals()
    return {name: names[name] for name in PARTS}


def stops(x, sides):
    right = vi.RigidStop(x["gap"], x["k"])
    return (right, vi.RigidStop(x["room"] - x["gap"], x["k"], "left"))[:sides]


def ideal(x, sides):
    return vi.Scene(
        oscillator=vi.Oscillator(x["xi"]), drive=vi.IdealDrive(x["zeta"]), stops=stops(x, sides)
    )


def sliding(x):
    return vi.Scene(
        oscillator=vi.Oscillator(x["xi"]), drive=vi.IdealDrive(x["zeta"]), stops=stops(x, 1),
        crank=vi.SliderCrank(x["ratio"]),
    )  # fmt: skip


def motor(x, clock):
    return vi.Scene(
        oscillator=vi.Oscillator(x["xi"]),
        drive=vi.Motor(x["tau0"], x["W"], x["eps"], x["mu"]),
        stops=stops(x, 1), clock_name=clock,
    )  # fmt: skip


GROUPS = {
    "exact, one stop": (lambda x: ideal(x, 1), vi.ExactFlight()),
    "exact, two stops": (lambda x: ideal(x, 2), vi.ExactFlight()),
    "steps, slider-crank": (sliding, vi.FixedStep()),
    "steps, motor by phase": (lambda x: motor(x, "phase"), vi.FixedStep()),
    "tolerance, motor in time": (lambda x: motor(x, "time"), vi.Adaptive(rtol=1e-7)),
    "tolerance, energy on the books": (
        lambda x: Budget(zeta=x["zeta"], xi=x["xi"], stops=stops(x, 2)),
        vi.Adaptive(rtol=1e-10),
    ),
}


def simulated(group, lanes, seed):
    build, method = GROUPS[group]

    def lane(x):
        scene = build(x)
        if isinstance(scene, Budget):
            start = Flow(x["Y"], x["V"], jnp.zeros(()))
        elif isinstance(scene.drive, vi.Motor):
            start = scene.start(Y=x["Y"], V=x["V"], W=x["W"])
        else:
            start = scene.start(Y=x["Y"], V=x["V"])
        run = vi.simulate(scene, start, CYCLES, method=method, max_impacts=300, max_steps=20_000)
        leaves = jax.tree_util.tree_leaves((run.sections, run.y_max, run.impact_energy))
        finite = jnp.isfinite(sum(jnp.sum(leaf) for leaf in leaves))
        deep = jnp.max(run.y_max) - x["gap"]
        if len(scene.stops) == 2:
            deep = jnp.maximum(deep, x["gap"] - x["room"] - jnp.min(run.y_min))
        gained = jnp.zeros(())
        if isinstance(scene, Budget):
            last, lost = run.last, jnp.sum(run.impact_energy)
            before = 0.5 * (x["Y"] ** 2 + x["V"] ** 2)
            gained = 0.5 * (last.Y**2 + last.V**2) - (before + last.E - lost)
        least = jnp.min(run.impact_energy)
        return number_of(run.result), finite, deep, gained, least, run.steps

    numbers = {name: jnp.asarray(x) for name, x in envelope(lanes, seed).items()}
    run = vi.jit(lambda xs: jax.lax.map(lane, xs, batch_size=64))
    return numbers, [np.asarray(x) for x in run(numbers)]


def check(group, lanes, seed):
    x, (codes, finite, deep, gained, least, steps) = simulated(group, lanes, seed)
    good = codes == 0
    assert steps.max() <= 20_001
    assert finite[good].all()
    size = np.abs(np.asarray(x["gap"])) + 1
    assert (deep[good] <= 1e-12 * size[good]).all()
    assert (least[good] >= 0).all()
    # Thousands of steps with a tolerance of 1e-10 each.
    scale = 1 + np.asarray(x["gap"]) ** 2 + np.asarray(x["V"]) ** 2
    assert (np.abs(gained[good]) <= 1e-7 * scale[good]).all()
    return codes


@pytest.mark.parametrize("group", ["exact, one stop", "steps, motor by phase"])
def test_random_scenes(group):
    codes = check(group, 512, 1)
    assert (codes == 0).mean() > 0.75


@pytest.mark.parametrize(
    "group", some(GROUPS, "exact, two stops", "steps, slider-crank", "tolerance, motor in time")
)
def test_a_hundred_thousand_random_scenes(group):
    for seed in range(2, 4 if "motor" in group else 7):
        check(group, 4_200, seed)
