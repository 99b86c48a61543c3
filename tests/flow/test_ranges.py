"""Invalid parameters that are traced or set by `eqx.tree_at` fail their lane."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.flow import number_of
from vi_jax.flow.results import code as code_of

CYCLES = 3
BASE = vi.Scene(
    damping_ratio=0.05, drive=vi.Motor(0.6, 0.9, 0.01, 0.005),
    stops=[vi.RigidStop(2.0, 0.5), vi.RigidStop(2.5, 0.5, "left")], crank=vi.SliderCrank(1 / 3),
    section_phase=0.1,
)  # fmt: skip
PLACES = {
    "restitution": lambda s: s.stops[0].restitution,
    "left restitution": lambda s: s.stops[1].restitution,
    "damping_ratio": lambda s: s.damping_ratio, "ratio": lambda s: s.crank.ratio,
    "strength": lambda s: s.drive.strength, "coupling": lambda s: s.drive.coupling,
    "slider_inertia": lambda s: s.drive.slider_inertia,
    "no_load_speed": lambda s: s.drive.no_load_speed, "section_phase": lambda s: s.section_phase,
    "gap": lambda s: s.stops[1].gap,
}  # fmt: skip
# The last gap leaves no room to the other stop at 2.
OUTSIDE = [2.0, -0.1, -0.9, -0.5, -1.0, -1.0, -1.0, 0.0, 7.0, -2.0]


@eqx.filter_jit
def lanes(values, settle):
    def lane(values, settle):
        scene = eqx.tree_at(lambda s: [place(s) for place in PLACES.values()], BASE, list(values))
        start = scene.start(Y=0.0, W=0.9)
        run = vi.simulate(scene, start, CYCLES, method=vi.FixedStep(), settle=settle)
        return number_of(run.result), run.sections.Y, run.steps

    return jax.vmap(lane)(values, settle)


def inside():
    return [float(place(BASE)) for place in PLACES.values()]


def test_traced_parameter_out_of_range_fails_only_its_lane():
    rows = [inside()]
    for i, value in enumerate(OUTSIDE):
        rows += [[*rows[0][:i], value, *rows[0][i + 1 :]], rows[0]]
    good = lanes(jnp.asarray(rows[:1] * len(rows)), jnp.full(len(rows), 1.0))
    codes, Y, steps = lanes(jnp.asarray(rows), jnp.full(len(rows), 1.0))
    expected = np.where(np.arange(len(rows)) % 2 == 1, code_of("bad_start"), 0)
    by_place = dict(zip(["base", *np.repeat(list(PLACES), 2)], codes.tolist(), strict=True))
    assert codes.tolist() == expected.tolist(), by_place
    fine = expected == 0
    np.testing.assert_array_equal(np.asarray(Y)[fine], np.asarray(good[1])[fine])
    assert np.isnan(np.asarray(Y)[~fine][:, 1:]).all()
    assert (np.asarray(steps)[~fine] == 0).all()


def test_traced_settle_must_be_a_number_of_cycles():
    settle = jnp.asarray([0.0, -5.0, jnp.nan, 2.5, jnp.inf, 1e300, 2.0])
    rows = jnp.asarray([inside()] * len(settle))
    codes, Y, _ = lanes(rows, settle)
    assert codes.tolist() == [0, *[code_of("bad_start")] * 5, 0]
    assert np.isfinite(np.asarray(Y)[[0, -1]]).all()
    # The same with traced integers.
    codes, again, _ = lanes(rows, jnp.asarray([0, -5, -1, 2, 2, 2, 2]))
    assert codes.tolist() == [0, code_of("bad_start"), code_of("bad_start"), 0, 0, 0, 0]
    np.testing.assert_array_equal(again[-1], Y[-1])


class Limited(vi.AbstractMachine):
    """A body under a restoring force of limited strength."""

    limit: Any
    cycle: Any = 1.0

    def field(self, s, state):
        return vi.OscillatorState(state.V, -jnp.clip(state.Y, -self.limit, self.limit))


def test_own_parameter_may_be_infinite_but_cycle_may_not():
    start = vi.OscillatorState(jnp.asarray(2.0), jnp.asarray(0.0))
    limits, cycles = (
        jnp.asarray([np.inf, np.inf, np.nan, 0.5]),
        jnp.asarray([1.0, np.inf, 1.0, 1.0]),
    )
    run = jax.vmap(lambda *numbers: vi.simulate(Limited(*numbers), start, 1))(limits, cycles)
    assert (run.result == vi.RESULTS.bad_start).tolist() == [False, True, True, False]
    np.testing.assert_allclose(run.last.Y[::3], [2 * np.cos(1.0), 2 - 0.25], rtol=1e-9)
    assert bool(vi.simulate(Limited(np.inf), start, 1).successful)


def test_invalid_constant_from_tree_at_is_a_bad_start():
    base = vi.Scene.ideal(frequency_ratio=0.9, damping_ratio=0.05)
    scene = eqx.tree_at(PLACES["damping_ratio"], base, jnp.asarray(-0.9))
    run = vi.simulate(scene, scene.start(), 2)
    assert run.result == vi.RESULTS.bad_start


def test_parameters_out_of_range_fail_the_run():
    """A negative crank radius changes only the sign of the dimensionless gap."""

    def code(radius):
        table = eqx.tree_at(lambda p: p.crank_radius, vi.Parameters(), radius)
        scene = table.scene(drive="ideal")
        return number_of(vi.simulate(scene, scene.start(Y=-3.0), 1).result)

    assert jax.jit(jax.vmap(code))(jnp.asarray([0.04, -0.04])).tolist() == [0, code_of("bad_start")]
    with pytest.raises(ValueError, match="crank_radius"):
        code(jnp.asarray(-0.04))


class Coupled(vi.Mechanical):
    """Two bodies whose masses are coupled."""

    q = ("x", "y")
    first: float = 1.0
    coupling: float = 0.0
    cycle: float = 1.0

    def mass(self, q):
        return [[self.first, self.coupling], [self.coupling, 1.0]]

    def force(self, t, q, v):
        return dict(x=-q.x, y=-q.y)


def test_masses_and_cycles_of_a_batch_must_be_positive():
    """Regression: lanes with a negative or indefinite mass were successful, and at x = -218."""

    def result(first, coupling, cycle):
        machine = Coupled(first=first, coupling=coupling, cycle=cycle)
        return vi.simulate(machine, machine.at(x=1.0), 2).result

    found = jax.vmap(result)(*jnp.array([[1, 0, 1], [-1, 0, 1], [1, 1.5, 1], [1, 0, -1.0]]).T)
    assert (found == vi.RESULTS.bad_start).tolist() == [False, True, True, True]


@pytest.mark.filterwarnings("ignore:vi_jax is running in single precision")
def test_single_precision_limits_counts():
    with jax.enable_x64(False):
        scene = vi.Scene.ideal(frequency_ratio=0.9)
        start = scene.start()
        for arguments in (
            {"settle": 2**24},
            {"settle": 2**14, "samples": 2**10},
            {"max_steps": 2**24 + 1},
            {"max_impacts": 2**24 + 1},
        ):
            with pytest.raises(ValueError, match=f"{next(iter(arguments))}.*at most"):
                vi.simulate(scene, start, 1, **arguments)

        def code(settle):
            return number_of(vi.simulate(scene, start, 1, settle=settle).result)

        assert jax.jit(code)(jnp.float32(2.0**24)) == code_of("bad_start")
        assert jax.jit(code)(jnp.float32(3.0)) == 0
