"""Branches with fixed quantities of the motion and further free parameters of the machine, and
extrema of quantities along a branch."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.optimize import brentq
from vi_jax.orbit import Orbits, conditions
from vi_jax.orbit.equations import Observed
from vi_jax.orbit.results import compound

ZETA, XI, GAP = "drive.frequency_ratio", "damping_ratio", "stops.0.gap"
DAMPING = 0.1


@pytest.fixture(scope="module")
def linear():
    """An orbit of the linear oscillator, out of reach of its stop."""
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=20.0, damping_ratio=DAMPING)
    return vi.find_orbit(scene, scene.start(), throw=True)


def test_unknown_names_of_extrema_raise(linear):
    for names in ("speed", ("y_min", "speed")):
        with pytest.raises(ValueError, match=r"`extrema` must be one of .*'y_max'"):
            vi.continue_orbit(linear, parameter=ZETA, bounds=(0.4, 1.6), extrema=names)


@pytest.mark.slow
def test_extrema_of_the_linear_oscillator(linear):
    """The amplitude is 1/√((1 - ζ²)² + (2ξζ)²). The section values are the real parts of the
    complex response and of its velocity."""
    sought = ("y_max", "y_min", "section_Y", "section_V", "clearance", "multiplier", "duration")
    free = vi.continue_orbit(linear, parameter=ZETA, bounds=(0.5, 1.5), extrema=sought)
    places = free.to_xarray(along="special").to_dataframe()
    assert (places.special_kind == "extremum").sum() == len(free.special)
    at = {name: [p for p in free.special if p.quantity == name] for name in free.column_names}
    peak, size = np.sqrt(1 - 2 * DAMPING**2), 1 / (2 * DAMPING * np.sqrt(1 - DAMPING**2))
    for name, value in (("y_max", size), ("y_min", -size), ("clearance", 20 - size)):
        (point,) = at[name]
        assert point.kind == "extremum" and point.parameter == pytest.approx(peak, abs=1e-11)
        assert float(getattr(point.orbit, name)) == pytest.approx(value, abs=1e-12)
        assert f"is the {'largest' if name == 'y_max' else 'least'} nearby" in str(point)
    # Re 1/(1 - ζ² + 2iξζ) is extreme at ζ² = 1 ∓ 2ξ.
    places = [point.parameter for point in at["section_Y"]]
    np.testing.assert_allclose(places, np.sqrt([1 - 2 * DAMPING, 1 + 2 * DAMPING]), atol=1e-11)
    (fastest,) = at["section_V"]  # Re iζ/(1 - ζ² + 2iξζ)
    assert fastest.parameter == pytest.approx(1.0, abs=1e-11)
    assert not at["duration"] and not at["multiplier"]  # both are monotonic


def branch_of_amplitude(orbit, size):
    return vi.continue_orbit(
        orbit, parameter=ZETA, bounds=(0.5, 1.5), free={XI: (0.001, 0.5)}, fixed={"y_max": size}
    )


@pytest.mark.slow
def test_an_amplitude_is_held_by_the_damping(linear, monkeypatch):
    """The amplitude 1/√((1 - ζ²)² + (2ξζ)²) is fixed. The branch ends at the least damping."""
    branch = branch_of_amplitude(linear, 3.0)
    np.testing.assert_allclose(branch.y_max, 3.0, atol=1e-12)
    zeta, xi = branch.parameter, branch.free[XI]
    np.testing.assert_allclose(np.hypot(1 - zeta**2, 2 * xi * zeta), 1 / 3, atol=1e-12)
    assert branch.ends == ("bounds", "bounds")
    np.testing.assert_allclose(xi[[0, -1]], 0.001, atol=1e-12)
    data = branch.to_xarray()
    np.testing.assert_array_equal(data[XI], xi)
    assert vi.plot_branch(branch, x=XI, y="multiplier").get_xlabel() == "damping ratio ξ"
    # Another value compiles no other program.
    traced, plain = [], conditions.quantity_at
    monkeypatch.setattr(conditions, "quantity_at", lambda *a: (traced.append(a[-1]), plain(*a))[1])
    branch = branch_of_amplitude(linear, 2.9)
    assert not traced and branch.y_max == pytest.approx(2.9, abs=1e-12)
    assert f"held: y_max = 2.9 a; by {XI} in [0.001, " in str(branch)


@pytest.fixture(scope="module")
def struck():
    """Return a branch of motions with one impact, of fixed least position and free gap."""
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5)
    near = vi.closed_form_orbits(scene)
    orbit = vi.find_orbit(scene, scene.start(Y=near.Y[0] - 1e-3, V=near.V[0]), throw=True)
    return vi.continue_orbit(
        orbit, parameter=ZETA, bounds=(0.6, 1.8), free={GAP: (1.1, 4.0)}, fixed={"y_min": -3.0}
    )


@jax.jit
@jax.vmap
def closed(zeta, gap):
    return vi.closed_form_orbits(vi.Scene.ideal(frequency_ratio=zeta, restitution=0.5, gap=gap))


@pytest.mark.slow
def test_a_motion_with_one_impact_agrees_with_its_closed_form(struck):
    inside = slice(1, None)  # the first point has lost its impact
    found = closed(jnp.asarray(struck.parameter), jnp.asarray(struck.free[GAP]))
    apart = np.abs(np.asarray(found.impact_speed) - struck.impact_speed)
    which = np.argmin(np.where(np.isnan(apart), np.inf, apart), axis=1)[inside]
    rows = np.arange(len(struck.parameter))[inside]
    np.testing.assert_allclose(np.asarray(found.y_min)[rows, which], -3.0, atol=1e-9)
    speeds = np.asarray(found.impact_speed)[rows, which]
    np.testing.assert_allclose(speeds, struck.impact_speed[inside, 0], atol=1e-9)
    traces = np.asarray(found.multipliers)[rows, which].sum(axis=-1)
    np.testing.assert_allclose(traces, struck.multipliers[inside].sum(axis=1), rtol=1e-7)


@pytest.mark.slow
def test_special_points_with_a_fixed_quantity(struck):
    """The impact is lost where the oscillator without a stop has amplitude 1/(1 - ζ²) = 3."""
    lost, doubling = struck.special
    assert (lost.kind, doubling.kind) == ("grazing", "period-doubling")
    assert lost.parameter == pytest.approx(np.sqrt(2 / 3), abs=1e-9)
    assert np.abs(doubling.orbit.multipliers + 1).min() < 1e-8
    gap = float(doubling.orbit.machine.stops[0].gap)

    def beyond(zeta):
        (values, _) = closed(jnp.array([zeta]), jnp.array([gap])).multipliers[0]
        return float(values.real.min()) + 1

    at = brentq(beyond, doubling.parameter - 1e-3, doubling.parameter + 1e-3, xtol=1e-13)
    assert doubling.parameter == pytest.approx(at, abs=1e-8)
    # After a switch the gap is an ordinary parameter.
    doubled = doubling.switch()
    assert int(doubled.cycles) == 2 and float(doubled.machine.stops[0].gap) == gap
    bounds = (0.9, 1.05), (0.45, 0.55)
    curve = vi.boundary(doubling, parameter="stops.0.restitution", bounds=bounds)
    assert np.abs(curve.multipliers + 1).min(axis=1).max() < 1e-8


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"free": {XI: (0.0, 0.5)}}, "`fixed` must hold as many numbers as `free` frees, 1"),
        ({"fixed": {"y_max": 3.0}}, "as many numbers as `free` frees, 0, but holds 1"),
        ({"free": {"xi": (0.0, 0.5)}, "fixed": {"y_max": 3.0}}, "`free` must be a number"),
        ({"free": {XI: (0.2, 0.5)}, "fixed": {"y_max": 3.0}}, "must hold the orbit's"),
        ({"free": {ZETA: (0.2, 1.5)}, "fixed": {"y_max": 3.0}}, "others than the parameter"),
        ({"free": {XI: (0.0, 0.5)}, "fixed": {"height": 3.0}}, "`fixed` must be one of .*'y_max'"),
        ({"free": {XI: (0.0, 0.5)}, "fixed": {"y_max": np.nan}}, r"`fixed\['y_max'\]` must be"),
        ({"free": {XI: (0.2, 0.5)}, "fixed": {"y_max": None}}, "`free` must hold the orbit's"),
        ({"free": {XI: (0.5, 0.0)}, "fixed": {"y_max": 3.0}}, r"`free\['.*'\]` must be two finite"),
    ],
)
def test_invalid_arguments_raise(linear, arguments, message):
    with pytest.raises(ValueError, match=message):
        vi.continue_orbit(linear, parameter=ZETA, bounds=(0.5, 1.5), **arguments)


def test_calls_that_need_multipliers_raise_without_them(linear):
    without = dataclasses.replace(linear, multipliers=jnp.nan * linear.multipliers)
    given = {"free": {XI: (0.001, 0.5)}, "fixed": {"multiplier": 0.5}}
    for call in (
        lambda: vi.continue_orbit(without, parameter=ZETA, bounds=(0.5, 1.5), **given),
        lambda: vi.plot_multipliers(without),
        lambda: vi.manifold(without),
    ):
        with pytest.raises(ValueError, match="must have multipliers, but they are not a num"):
            call()
    assert "nan" not in str(Orbits([without])) and "without multipliers" in str(Orbits([without]))
    both = jax.tree.map(lambda *x: jnp.stack(x), without, without)
    assert "2 orbits found, without multipliers" in str(both)


@pytest.mark.slow
def test_a_multiplier_is_held_until_another_is_as_large():
    """The two multipliers of a motion with one impact have the product (k exp(-2π ξ/ζ))². They
    have equal size where k exp(-2π ξ/ζ) equals the fixed size."""
    zeta, xi = 0.9, 0.05
    scene = vi.Scene.ideal(frequency_ratio=zeta, restitution=0.5, gap=1.6, damping_ratio=xi)
    near = vi.closed_form_orbits(scene)
    orbit = vi.find_orbit(scene, scene.start(Y=near.Y[0] - 1e-3, V=near.V[0]), throw=True)
    size = float(np.abs(orbit.multipliers).max())
    assert float(np.abs(orbit.multipliers).min()) < 0.9 * size < 0.9
    given = {"free": {GAP: (0.5, 4.0)}, "fixed": {"multiplier": None}}
    branch, cut = (
        vi.continue_orbit(orbit, parameter="stops.0.restitution", bounds=(0.3, end), **given)
        for end in (0.99, size * np.exp(2 * np.pi * xi / zeta) + 1e-4)
    )
    assert branch.ends[1] == cut.ends[1] == "multiplier"  # although a bound lies in the same step
    assert cut.parameter[-1] == pytest.approx(branch.parameter[-1], abs=1e-8)
    np.testing.assert_allclose(branch.multiplier, size, rtol=1e-6)
    assert branch.parameter[-1] == pytest.approx(size * np.exp(2 * np.pi * xi / zeta), abs=1e-8)


def test_a_pair_of_multipliers_is_held_until_it_turns_real():
    """The second compound of a matrix has the products of its eigenvalues as eigenvalues."""
    turn = 0.7 * np.array([[np.cos(1.0), -np.sin(1.0)], [np.sin(1.0), np.cos(1.0)]])
    matrix = np.zeros((3, 3))
    matrix[:2, :2], matrix[2, 2] = turn, 0.3
    base = np.random.default_rng(0).normal(size=(3, 3))
    products = np.linalg.eigvals(compound(jnp.asarray(base @ matrix @ np.linalg.inv(base))))
    expected = [0.49, 0.21 * np.exp(1j), 0.21 * np.exp(-1j)]
    np.testing.assert_allclose(np.sort_complex(products), np.sort_complex(expected), atol=1e-12)
    pair = [0.7 * np.exp(1j), 0.7 * np.exp(-1j)]
    (pair_held,) = conditions.hold_values({"multiplier": 0.7}, np.array([*pair, 0.3]))
    assert pair_held.pair

    def dominance_margin(*values):
        rest = dict.fromkeys(Observed._fields[1:])
        return pair_held.dominance_margin(Observed(multipliers=np.array(values), **rest))

    assert dominance_margin(*pair, 0.3) < 0
    assert dominance_margin(0.75, 0.49 / 0.75, 0.3) > 0 and dominance_margin(0.8, *pair) > 0
