"""Every function and plot on every kind of machine, with results compared between functions."""

import warnings
from typing import Any, NamedTuple

import jax
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.machine import component, section_in

from differences import some
from two_bodies import TwoBodies

matplotlib.use("Agg")
M = vi.machines


class Case(NamedTuple):
    """A machine with a stable orbit of one cycle, and the special points in a parameter."""

    machine: Any
    place: str
    speed: str
    parameter: str
    bounds: tuple[float, float]
    special: tuple[str, ...]
    """Kinds of the special points along the branch."""
    curved: str
    """Kind of the special point that is followed in a second parameter."""
    second: str
    ends: tuple[float, float]


CASES = {
    "pair": Case(
        M.ImpactPair(), "place", "v.place", "half_gap", (1.2, 3.0), ("symmetry-breaking",),
        "symmetry-breaking", "restitution", (0.4, 0.6),
    ),
    "valve": Case(
        M.ReliefValve(flow_rate=5.0), "lift", "pressure", "flow_rate", (4.0, 8.0),
        ("period-doubling", "grazing"), "period-doubling", "restitution", (0.75, 0.85),
    ),
    "capsule": Case(
        M.Capsule(), "place", "v.place", "amplitude", (0.8, 3.0), ("grazing", "grazing"),
        "grazing", "friction", (0.9, 1.1),
    ),
    "rotor": Case(
        M.UnbalancedRotor(gap=1.0), "Y", "v.Y", "control", (0.6, 1.2),
        ("grazing", "period-doubling"), "period-doubling", "gap", (0.95, 1.05),
    ),
    "two bodies": Case(
        TwoBodies(), "x", "y", "drive", (0.3, 1.0), ("grazing", "period-doubling"),
        "period-doubling", "gap", (0.55, 0.65),
    ),
}  # fmt: skip


# `tests/test_checks.py` runs the pair, with annotations checked.
@pytest.fixture(scope="module", params=some(CASES))
def case(request):
    return CASES[request.param]


@pytest.fixture(scope="module")
def orbit(case):
    settled = vi.simulate(case.machine, case.machine.start(), 1, settle=500)
    return vi.find_orbit(case.machine, settled.last, throw=True)


@pytest.fixture(scope="module")
def branch(case, orbit):
    return vi.continue_orbit(orbit, parameter=case.parameter, bounds=case.bounds)


@pytest.fixture(autouse=True)
def _draw_and_close_figures():
    yield
    for number in plt.get_fignums():
        plt.figure(number).canvas.draw()
    plt.close("all")


def value_of(case):
    return float(getattr(case.machine, case.parameter))


def test_simulate(case, orbit):
    driven = section_in(case.machine, orbit.state) is None
    run = vi.simulate(
        case.machine, orbit.state, 3, samples=16 if driven else 0, impact_log=8, estimate=True
    )
    assert bool(run.successful)
    assert max(float(x.max()) for x in jax.tree.leaves(run.errors.sections)) < 1e-5
    for found, wanted in zip(*map(jax.tree.leaves, (run.sections, orbit.state)), strict=True):
        # The multipliers are below 1, so errors decay.
        np.testing.assert_allclose(found, np.broadcast_to(wanted, 4), atol=1e-5)
    np.testing.assert_array_equal(run.impacts, int(orbit.impacts))
    np.testing.assert_allclose(run.y_max[1:], orbit.y_max, atol=1e-5)
    np.testing.assert_array_equal(run.to_xarray()["error_y_max"], run.errors.y_max)
    vi.plot_sketch(case.machine)
    if driven:
        vi.plot_history(run, machine=case.machine)
        vi.plot_phase_portrait(run, case.machine)
        assert len(vi.animate(run, case.machine, seconds=0.3, fps=10)) == 3
    else:  # only machines observed at equal times have samples
        with pytest.raises(ValueError, match="samples"):
            vi.plot_history(run, machine=case.machine)


def test_find_orbit(case, orbit):
    assert int(orbit.cycles) == 1 and bool(orbit.stable)
    assert "stable" in str(orbit)
    vi.plot_multipliers(orbit)


def test_lyapunov(case, orbit):
    """On an orbit the exponents are the logarithms of its multipliers."""
    spectrum = vi.lyapunov(case.machine, orbit.state, cycles=200)
    with np.errstate(divide="ignore"):
        logs = np.log(np.abs(np.asarray(orbit.multipliers)))
    if section_in(case.machine, orbit.state) is not None:  # the exponent along the motion is zero
        logs[logs.argmin()] = 0.0
    logs = np.sort(logs)[::-1]
    alive = logs > -20  # others are zero up to rounding
    rates = np.asarray(spectrum.per_cycle)
    np.testing.assert_allclose(rates, spectrum.exponents * orbit.duration, rtol=1e-6)
    np.testing.assert_allclose(rates[alive], logs[alive], atol=1e-3)
    assert (rates[~alive] < -10).all()


@pytest.mark.slow
def test_continue_orbit(case, orbit, branch):
    assert tuple(point.kind for point in branch.special) == case.special
    (again,) = (o for o in branch.at(value_of(case)) if bool(o.stable))
    for a, b in zip(*map(jax.tree.leaves, (again.state, orbit.state)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-7)
    for point in branch.special:
        M = np.asarray(point.orbit.monodromy)
        lost = {"period-doubling": -1.0, "fold": 1.0, "symmetry-breaking": 1.0}.get(point.kind)
        if lost is not None:
            assert abs(np.linalg.eigvals(M) - lost).min() < 1e-5
    ax, data = vi.plot_branch(branch), branch.to_xarray()
    position = case.machine.units.get("position", "1")
    assert data.y_min.attrs.get("units", "1") == data.clearance.attrs.get("units", "1") == position
    assert ax.get_ylabel().endswith(f" ({position})") or position == "1"


@pytest.mark.slow
def test_boundary(case, branch):
    point = next(point for point in branch.special if point.kind == case.curved)
    bounds = (case.bounds, case.ends)
    if "coincide" in point.detail:
        with pytest.raises(ValueError, match="something is touched"):
            vi.boundary(point, parameter=case.second, bounds=bounds)
        return
    curve = vi.boundary(point, parameter=case.second, bounds=bounds)
    assert len(curve.parameters) > 5 and curve.kind == point.kind
    lost = {"period-doubling": -1.0, "symmetry-breaking": 1.0}.get(curve.kind)
    if lost is not None:
        assert abs(curve.multipliers - lost).min(axis=1).max() < 1e-7
    elif point.impact is None:
        np.testing.assert_allclose(curve.clearance, 0, atol=1e-9)
    apart = np.abs(curve.parameters[:, 0] - point.parameter)
    here = np.abs(curve.parameters[:, 1] - float(getattr(case.machine, case.second)))
    assert apart[here.argmin()] < 1e-8
    vi.plot_boundary(curve)


def test_sweep(case, orbit, branch):
    near = value_of(case) + 0.01 * np.arange(3)
    swept = vi.sweep(
        case.machine, case.parameter, near, start=orbit.state, settle=400, cycles=8,
    )  # fmt: skip
    for value, low in zip(near, swept.y_min, strict=True):
        (there,) = (o for o in branch.at(value) if bool(o.stable))
        assert float(low) == pytest.approx(float(there.y_min), abs=1e-5)
    vi.plot_sweep(swept)


def test_scan(case, orbit):
    near = value_of(case) + np.array([0.0, 0.01])
    place = f"start.{case.place}"
    data = vi.scan(
        case.machine, {case.parameter: near, place: float(component(case.place, orbit.state))
                       + np.array([0.0, 1e-3])},
        start=orbit.state, settle=200, cycles=128,
        measure=[vi.Regime(), "extremes", vi.Sections(), "impact_rate", vi.Exponent()],
    )  # fmt: skip
    units = case.machine.units
    for name, unit in (("y_min", "position"), ("impact_speed", "velocity"), ("exponent", "rate")):
        assert data[name].attrs.get("units", "1") == units.get(unit, "1")
    assert (np.asarray(data["period"]) == 1).all() and (np.asarray(data["result"]) == 0).all()
    np.testing.assert_allclose(data["y_max"][0], orbit.y_max, atol=1e-5)
    vi.plot_regimes(data, machine=case.machine)


@pytest.mark.slow
def test_basins(case, orbit):
    ends = {
        f"start.{name}": tuple(float(component(name, orbit.state)) + np.array([-0.02, 0.01]))
        for name in (case.place, case.speed)
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # starts beyond a stop fail
        found = vi.basins(case.machine, ends, start=orbit.state, resolution=4, settle=300)
    assert found.attractors and found.attractors[0].period == 1
    sections = found.attractors[0].sections
    place = float(component(case.place, orbit.state))
    assert float(sections[case.place][0]) == pytest.approx(place, abs=1e-4)
    vi.plot_basins(found)


@pytest.mark.slow
def test_suggest_method(case):
    found = vi.suggest_method(case.machine, error=1e-4, cycles=3, lanes=8)
    assert found.reached and found.error <= 1e-4


def test_closed_form_orbits_need_a_scene(case):
    # Checked annotations raise, or else `closed_form_orbits` itself.
    with pytest.raises((TypeError, ValueError), match="scene"):
        vi.closed_form_orbits(case.machine)
