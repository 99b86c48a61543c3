"""Compare found orbits with the closed form, long simulations, differences and each other."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp

from dragging import Dragging

UNDAMPED = vi.Scene.ideal(frequency_ratio=0.9)


def near(scene, cycles, by=0.01):
    closed = vi.closed_form_orbits(scene, cycles=cycles)
    return scene.start(Y=closed.Y[0] - by, V=closed.V[0] - by)


@pytest.mark.slow
def test_cycles_accepts_the_number_of_an_orbit():
    orbit = vi.find_orbit(UNDAMPED, near(UNDAMPED, 1))
    again = vi.find_orbit(UNDAMPED, orbit.state, cycles=orbit.cycles)
    run = vi.simulate(UNDAMPED, orbit.state, orbit.cycles, method=vi.ExactFlight())
    assert int(again.cycles) == run.impacts.size == 1
    assert float(again.state.Y) == pytest.approx(float(run.last.Y), abs=1e-12)
    with pytest.raises(TypeError, match="`cycles` must be an integer that is known"):
        jax.jit(lambda n: vi.find_orbit(UNDAMPED, orbit.state, cycles=n).state)(1)


class VanDerPol(vi.AbstractMachine):
    """Y'' - μ(1 - Y²)Y' + Y = 0, with a nonsmooth guard of the section: min(Y, 2Y') = 0.1."""

    mu: jax.Array

    cycle = vi.rising(lambda m, x: jnp.minimum(x.Y, 2 * x.V) - 0.1, usual=6.6633)

    def field(self, s, state):
        return vi.OscillatorState(state.V, self.mu * (1 - state.Y**2) * state.V - state.Y)


def test_an_orbit_agrees_with_a_simulation():
    """Compare with the same method in a simulation, and the period with SciPy."""
    machine = VanDerPol(jnp.asarray(5.0))
    start = vi.OscillatorState(jnp.asarray(1.0), jnp.asarray(0.0))
    settled = vi.simulate(machine, start, 1, settle=40)
    orbit = vi.find_orbit(machine, settled.last)
    run = vi.simulate(machine, orbit.state, 1)
    # Both locate the section to 1e-9 in the clock, with a second-order effect on the period.
    # Adaptive steps depend on how the code is compiled, and the orbit's program has derivatives:
    # 3e-11 was observed, and 2e-12 in the extremes.
    assert float(orbit.duration) == pytest.approx(float(run.duration[0]), abs=1e-10)
    assert float(orbit.y_max) == pytest.approx(float(run.y_max[0]), abs=1e-11)

    def field(_, x):
        return [x[1], 5 * (1 - x[0] ** 2) * x[1] - x[0]]

    def rises(_, x):
        return x[0]

    rises.direction = 1
    truth = solve_ivp(field, (0, 150), [1, 0], "DOP853", rtol=1e-13, atol=1e-13, events=rises)
    assert float(orbit.duration) == pytest.approx(np.diff(truth.t_events[0])[-1], abs=1e-9)


def test_text_and_tables_of_orbits():
    orbit = vi.find_orbit(UNDAMPED, near(UNDAMPED, 1), cycles=1)
    assert "are listed" not in str(orbit)
    # A body that comes to rest has more impacts than are logged.
    more = dataclasses.replace(orbit, impacts=jnp.asarray(38))
    assert "  only 1 of 38 impacts: find it with `impact_log=38`" in str(more)
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), orbit)
    data = batch.to_xarray()
    assert data["result"].values.tolist() == ["successful"] * 2
    assert data["stability"].values.tolist() == ["period_doubling"] * 2
    assert data["section_Y"].dims == ("lane", "section")
    np.testing.assert_array_equal(data["multipliers"][0], orbit.multipliers)
    assert orbit.to_xarray()["impact_speed"].shape == (1,)
    orbits, counts = vi.distinct_orbits(batch)
    assert isinstance(orbits, list) and counts.tolist() == [2]
    assert str(orbits).splitlines() == [
        "1 orbit",
        "  2π, 1 impact, unstable: Y = 1.92303 a, V = -0.876442 a ω; Y in [-1.88358, 2] a; "
        "greatest multiplier 1.16604",
    ]
    assert str(orbits) in str((orbits, counts))


@pytest.mark.slow
def test_a_grid_of_closed_forms(cycles=2):
    grid = [[0.86, 0.9, 0.94, 1.0, 1.9, 2.2], [0.3, 0.5, 0.8], [1.2, 2.0], [0.0, 0.0448, 0.2]]
    zeta, k, d, xi = (jnp.asarray(x.ravel()) for x in np.meshgrid(*grid))

    @jax.jit
    @jax.vmap
    def both(zeta, k, d, xi):
        scene = vi.Scene.ideal(frequency_ratio=zeta, restitution=k, gap=d, damping_ratio=xi)
        closed = vi.closed_form_orbits(scene, cycles=cycles)
        found = vi.find_orbit(scene, near(scene, cycles, 1e-4), cycles=cycles)
        trace = jnp.trace(found.monodromy), jnp.linalg.det(found.monodromy)
        return closed, found, trace

    closed, found, (trace, determinant) = both(zeta, k, d, xi)
    there = np.asarray(closed.admissible)[:, 0] & (np.asarray(closed.impact_speed)[:, 0] > 0.1)
    # At resonance without damping the impact is on the section, where the cycle map jumps, so that
    # a search cannot converge.
    phase = np.asarray(closed.impact_phase)[:, 0]
    there &= np.minimum(phase, 2 * np.pi * cycles - phase) > 1e-6
    assert there.sum() > 10
    assert np.asarray(found.successful)[there].all()
    for a, b in ((found.state.Y, closed.Y), (found.state.V, closed.V), (found.y_min, closed.y_min)):
        np.testing.assert_allclose(np.asarray(a)[there], np.asarray(b)[there, 0], atol=1e-10)
    assert (np.asarray(found.impacts) == 1)[there].all() and found.admissible[there].all()
    for name in ("impact_phase", "impact_speed"):
        mine, its = (np.asarray(getattr(x, name))[there, 0] for x in (found, closed))
        np.testing.assert_allclose(mine, its, atol=1e-9)
    analytic = np.asarray(closed.multipliers)[there, 0]
    np.testing.assert_allclose(np.asarray(trace)[there], analytic.sum(-1).real, atol=1e-9)
    np.testing.assert_allclose(np.asarray(determinant)[there], analytic.prod(-1).real, atol=1e-9)
    largest = np.abs(np.asarray(found.multipliers)[there, 0])
    np.testing.assert_allclose(largest, np.abs(analytic).max(-1), atol=1e-9)


@pytest.mark.slow
def test_many_guesses_in_one_program(compilations):
    draw = np.random.default_rng(0).uniform
    Y, V = jnp.asarray(draw(-3, 2, 4096)), jnp.asarray(draw(-3, 3, 4096))

    def search(zeta):
        scene = vi.Scene.ideal(frequency_ratio=zeta, restitution=0.8)
        return vi.find_orbit(scene, scene.start(Y=Y, V=V), cycles=2)

    first = search(0.9)
    compilations.clear()
    second = search(0.91)
    jax.block_until_ready(second.state)
    assert not compilations
    for batch in (first, second):
        assert batch.residual.shape == (4096,)
        orbits, counts = vi.distinct_orbits(batch)
        assert [int(orbit.cycles) for orbit in orbits] == [1, 2]
        assert [bool(orbit.stable) for orbit in orbits] == [False, True]
        assert counts.sum() == int(batch.successful.sum()) > 1500
        for orbit in orbits:
            closed = vi.closed_form_orbits(
                vi.Scene.ideal(
                    frequency_ratio=orbit.machine.drive.frequency_ratio, restitution=0.8
                ),
                cycles=int(orbit.cycles),
            )
            assert float(orbit.y_min) == pytest.approx(float(closed.y_min[0]), abs=1e-9)
            assert float(orbit.impact_speed[0]) == pytest.approx(float(closed.impact_speed[0]))


@pytest.mark.slow
def test_a_gradient_without_an_orbit_is_nan():
    def lowest(zeta):
        scene = vi.Scene.ideal(
            frequency_ratio=zeta, restitution=0.56437685, gap=1.22917006, damping_ratio=0.02
        )
        guess = scene.start(Y=0.4013157121071995, V=-0.1321048632913019)
        few = vi.Newton(max_steps=2)
        return vi.find_orbit(scene, guess, root_finder=few, multipliers=False).y_min

    assert np.isnan(jax.grad(lowest)(1.15136991))


@pytest.mark.slow
def test_multiple_shooting_converges_where_one_arc_fails():
    """200 cycles of the unstable 2π motion amplify rounding by 1.166^200 = 2e13."""
    closed = vi.closed_form_orbits(UNDAMPED)
    # The guess is exact to rounding. With an error of 1e-13 the last arcs begin on another motion,
    # and the last digits decide whether the search converges.
    guess = vi.find_orbit(UNDAMPED, near(UNDAMPED, 1)).state
    one = vi.find_orbit(UNDAMPED, guess, cycles=200)
    many = vi.find_orbit(UNDAMPED, guess, cycles=200, root_finder=vi.Newton(arcs=20))
    assert float(many.residual) < 1e-12 and int(many.cycles) == 1
    assert many.result == vi.ORBIT_RESULTS.smaller_period
    assert float(many.state.Y) == pytest.approx(float(closed.Y[0]), abs=1e-13)
    assert not bool(one.successful) and float(one.residual) > 1e-6


@pytest.mark.slow
def test_results_of_unsuccessful_searches():
    results = vi.ORBIT_RESULTS
    twice = vi.find_orbit(UNDAMPED, near(UNDAMPED, 1), cycles=2)
    assert twice.result == results.smaller_period and int(twice.cycles) == 1
    assert float(twice.multipliers[0].real) == pytest.approx(-1.166036, abs=1e-6)  # from the paper
    # Three Newton steps from this guess do not converge.
    scene = vi.Scene.ideal(frequency_ratio=0.72, gap=1.5, restitution=0.8)
    none = vi.find_orbit(scene, scene.start(Y=-3.0, V=3.0), root_finder=vi.Newton(max_steps=3))
    assert none.result == results.no_orbit and "no orbit" in str(none)
    with pytest.raises(Exception, match="The search failed, no_orbit"):
        jax.block_until_ready(
            vi.find_orbit(
                scene, scene.start(Y=-3.0, V=3.0), root_finder=vi.Newton(max_steps=3), throw=True
            )
        )
    beyond = vi.find_orbit(
        UNDAMPED, UNDAMPED.start(Y=jnp.array([2.5, 1.9]), V=jnp.array([0, -0.9]))
    )
    assert (beyond.result == results.not_simulated).tolist() == [True, False]
    assert beyond.successful.tolist() == [False, True]


@pytest.mark.parametrize("section", [-2 * np.pi, np.pi])
def test_the_search_accepts_every_section(section):
    """The search moves its section away from impacts, but by no more than a turn."""
    scene = vi.Scene.ideal(
        frequency_ratio=3.2, restitution=0.9, gap=1.05, damping_ratio=0.002
    ).at_section(section)
    Y, V = np.random.default_rng(1).uniform((-3.5, -4.0), (1.05, 4.0), (32, 2)).T
    guesses = scene.start(Y=jnp.asarray(Y), V=jnp.asarray(V))
    batch = vi.find_orbit(scene, guesses, cycles=1, section=section)
    assert bool(batch.successful.all())
    np.testing.assert_allclose(batch.y_max, 1 / (3.2**2 - 1), atol=1e-5)


@pytest.mark.slow
def test_an_impact_next_to_the_section_keeps_its_energy():
    """The section lies 1e-15 to 1e-12 before or after the impact of the same motion."""
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=1.0, damping_ratio=0.05)
    run = vi.simulate(scene, scene.start(), 1, settle=300, impact_log=1)
    for offset in (1e-15, -1e-15, 5e-15, -5e-15, 1e-12, -1e-12):
        moved = scene.at_section(run.impact_log.phase[0, 0] + offset)
        begin = vi.simulate(moved, moved.start(), 1, settle=301)
        cycle = vi.find_orbit(moved, begin.last).trajectory()
        assert cycle.impacts.tolist() == [1]
        np.testing.assert_allclose(cycle.impact_energy, run.impact_energy, rtol=1e-11)


@pytest.mark.slow
def test_gradients_by_the_implicit_function_theorem():
    """Compare gradients of an extremum, an impact speed and a multiplier with differences."""

    def quantities(x):
        zeta, k, xi, gap = x
        scene = vi.Scene.ideal(frequency_ratio=zeta, restitution=k, damping_ratio=xi, gap=gap)
        orbit = vi.find_orbit(scene, scene.start(Y=1.9, V=-0.9))
        return jnp.stack([orbit.y_min, orbit.impact_speed[0], jnp.abs(orbit.multipliers[0])])

    x, steps = jnp.array([0.9, 0.5, 0.01, 2.0]), 1e-5 * jnp.eye(4)
    ahead, behind = jax.jit(jax.vmap(quantities))(jnp.concatenate([x + steps, x - steps])).reshape(
        2, 4, 3
    )
    slopes = jax.jit(jax.jacrev(quantities))(x)
    np.testing.assert_allclose(slopes, (ahead - behind).T / 2e-5, atol=1e-6)


@pytest.mark.slow
def test_second_derivatives_where_a_body_may_rest():
    """Compare with differences of gradients. Multipliers would need third derivatives."""

    def orbit(gap):
        scene = vi.Scene.ideal(frequency_ratio=1.0, restitution=0.5, gap=gap, damping_ratio=0.05)
        return vi.find_orbit(scene, scene.start(Y=0.4476, V=1.9642), multipliers=False)

    found = str(orbit(0.5))
    assert "impact, without multipliers" in found and "multipliers:" not in found
    slope, step = jax.jit(jax.grad(lambda gap: orbit(gap).state.Y)), 1e-4
    wanted = (slope(0.5 + step) - slope(0.5 - step)) / (2 * step)
    np.testing.assert_allclose(jax.grad(slope)(0.5), wanted, rtol=1e-6)


@pytest.mark.slow
def test_a_motion_of_five_cycles():
    """The tolerance is for each cycle, over which the residual sums the steps' errors. SciPy, from
    event to event, gives the multipliers by differences."""
    machine = Dragging(1.2235349288777575, 1.563638946789845, 0.4590268753885736, 0.769947412071461)
    start = machine.at(x=-1.72001113752, y=-1.27188454372, v=dict(x=1.35574894278, y=-0.5780788535))
    orbit = vi.find_orbit(machine, start, cycles=5, throw=True)
    assert int(orbit.cycles) == 5 and int(orbit.impacts) == 5
    sizes = np.sort(np.abs(orbit.multipliers))
    expected = [7.78943e-3, 5.612925e-2, 0.85900329, 0.85900329]
    np.testing.assert_allclose(sizes, expected, rtol=0, atol=1e-7)


def test_invalid_arguments_raise():
    for arguments, message in (
        ({"cycles": 0}, "`cycles` must be at least 1"),
        ({"root_finder": vi.Newton(arcs=3), "cycles": 4}, "arcs that divides 4 cycles"),
    ):
        with pytest.raises(ValueError, match=message):
            vi.find_orbit(UNDAMPED, UNDAMPED.start(), **arguments)
    with pytest.raises(ValueError, match="`guess` must be finite, but its V is nan"):
        vi.find_orbit(UNDAMPED, UNDAMPED.start().__class__(jnp.asarray(0.0), jnp.asarray(jnp.nan)))
    with pytest.raises(ValueError, match="rows of one length"):
        vi.find_orbit(UNDAMPED, UNDAMPED.start(Y=jnp.zeros(3), V=jnp.zeros(4)))
    with pytest.raises(ValueError, match="`tolerance` must be finite and in"):
        vi.Newton(tolerance=-1.0)


class Coupled(vi.AbstractMachine):
    """Two bodies joined by a spring: x'' = y - x - c x' + cos s, y'' = x - y - c y' + push. Their
    mean position is arbitrary."""

    damping: jax.Array = eqx.field(default=0.3, converter=jnp.asarray)
    push: jax.Array = eqx.field(default=0.0, converter=jnp.asarray)
    cycle = 2 * np.pi

    def field(self, s, z):
        pull = z.y - z.x
        force = pull - self.damping * z.v + jnp.cos(s)
        return dict(x=z.v, v=force, y=z.w, w=self.push - pull - self.damping * z.w)


def sledge_speeds(damping):
    """Return both velocities at s = 0, from the responses of sum and difference."""
    both, apart = 1 / (1j + damping), 1j / (1 + 1j * damping)
    return (both + apart).real / 2, (both - apart).real / 2


class Free(vi.AbstractMachine):
    cycle: float = 2 * np.pi / 50

    def field(self, t, z):
        return dict(x=z.u, u=-2500.0 * z.x)


def test_where_every_motion_repeats_the_guess_is_the_orbit():
    """All singular values of the equations are rounding: it led away from the guess, to rest."""
    orbit = vi.find_orbit(Free(), vi.State(x=-0.01, u=0.0), method="reference")
    assert bool(orbit.successful) and float(orbit.state.x) == pytest.approx(-0.01, abs=1e-12)


@pytest.mark.exhaustive
def test_a_motion_of_arbitrary_position_is_found_near_the_guess():
    """A multiplier is 1 to rounding, so that the equations of the orbit are singular."""
    guess = vi.State(x=0.35, v=0.1, y=0.35, w=-0.2)  # equal positions
    orbit = vi.find_orbit(Coupled(), guess)
    assert bool(orbit.successful) and orbit.stability == vi.STABILITY.neutral
    assert not bool(orbit.stable)
    speeds = [float(orbit.state.v), float(orbit.state.w)]
    assert speeds == pytest.approx(sledge_speeds(0.3), abs=1e-10)
    assert float(orbit.state.x + orbit.state.y) == pytest.approx(0.7, abs=1e-10)
    with pytest.raises(ValueError, match="has a multiplier of exactly 1"):
        vi.continue_orbit(orbit, parameter="damping", bounds=(0.2, 0.5))
    found = jax.jacrev(lambda c: vi.find_orbit(Coupled(c), guess).state)(jnp.asarray(0.3))
    h = 1e-6
    wanted = np.subtract(sledge_speeds(0.3 + h), sledge_speeds(0.3 - h)) / (2 * h)
    assert [float(found.v), float(found.w)] == pytest.approx(wanted, abs=1e-8)
    assert float(found.x + found.y) == pytest.approx(0, abs=1e-10)
    drifting = vi.find_orbit(Coupled(push=0.01), guess)
    assert drifting.result == vi.ORBIT_RESULTS.drifts and "drifts" in str(drifting)


class Resonant(vi.AbstractMachine):
    """2 x'' + 50 x = 3 cos ωt, in N, kg and m. Its motion is (1.5 cos ωt)/(25 - ω²)."""

    omega: float = 5.0
    cycle = property(lambda self: 2 * jnp.pi / self.omega)

    def field(self, t, z):
        return dict(x=z.u, u=1.5 * jnp.cos(self.omega * t) - 25 * z.x)


def test_no_orbit_at_a_resonance_without_damping():
    start = vi.State(x=0.0, u=0.0)
    assert vi.find_orbit(Resonant(), start).result == vi.ORBIT_RESULTS.no_orbit
    orbit = vi.find_orbit(Resonant(5.001), start)
    assert orbit.successful
    np.testing.assert_allclose(orbit.state.x, 1.5 / (25 - 5.001**2), rtol=1e-7)
