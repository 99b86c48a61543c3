"""Long functions end soon after Ctrl-C, and keep their results."""

import importlib
import inspect
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from grazings import grazing_of

MOTOR = vi.Parameters().scene(drive="motor")
VALUES = jnp.linspace(0.7, 1.3, 40)


def interrupt_at(monkeypatch, place, after):
    """Raise `KeyboardInterrupt` at the call of a function after `after` calls."""
    module, name = (
        importlib.import_module("vi_jax." + place.rpartition(".")[0]),
        place.split(".")[2],
    )
    real, left = getattr(module, name), [after]

    def until(*arguments, **options):
        left[0] -= 1
        if left[0] < 0:
            raise KeyboardInterrupt
        return real(*arguments, **options)

    monkeypatch.setattr(module, name, until)


def interrupted_by(kind, call):
    """Return the error of an interrupted call. A bare `KeyboardInterrupt` fails the test, instead
    of ending all tests."""
    with pytest.raises(KeyboardInterrupt) as caught:
        call()
    assert isinstance(caught.value, kind), repr(caught.value)
    return caught.value


@pytest.mark.slow
def test_interrupted_basins_end_soon():
    """Alone on two cores, basins end within two seconds (0.02 to 0.1 s plus the import of xarray).
    The limit is larger, since other tests run at the same time."""
    done = subprocess.run(
        [sys.executable, Path(__file__).parent / "interrupted_basins.py"],
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    short, long = (line.split() for line in done.stdout.splitlines())
    for ended, free in (short[:2], long[:2]):
        assert float(ended) < 10 and float(free) < 10, done.stdout
    assert int(short[2]) > 0 == int(long[2]), done.stdout


def test_an_interrupted_sweep_keeps_completed_values(monkeypatch):
    whole = vi.sweep(MOTOR, "drive.control", VALUES, settle=4, cycles=4)
    assert whole.values.shape == (40,) and bool(whole.successful.all())
    interrupt_at(monkeypatch, "scans._sweep._sweep", after=2)
    error = interrupted_by(
        vi.Interrupted, lambda: vi.sweep(MOTOR, "drive.control", VALUES, settle=4, cycles=4)
    )
    part = error.partial
    assert "the sweep was interrupted" in str(error)
    assert isinstance(part, vi.Sweep)
    np.testing.assert_array_equal(part.values, VALUES[:32])
    np.testing.assert_array_equal(part.y_min, whole.y_min[:32])
    np.testing.assert_array_equal(part.sections.W, whole.sections.W[:32])


@pytest.mark.slow
def test_an_interrupted_branch_is_a_branch(monkeypatch):
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.0)
    orbit = vi.find_orbit(scene, scene.start(Y=1.6, V=-1.9), cycles=2)

    interrupt_at(monkeypatch, "orbit._follow.advance", after=5)
    options = {"parameter": "stops.0.gap", "bounds": (1.5, 2.5)}
    part = interrupted_by(vi.Interrupted, lambda: vi.continue_orbit(orbit, **options)).partial
    assert isinstance(part, vi.Branch) and part.ends == ("interrupted", "interrupted")
    assert 2 <= len(part.parameter) <= 6 and part.parameter[0] == pytest.approx(2.0)
    assert bool(part.orbit(-1).successful)


@pytest.mark.slow
def test_interrupted_basins_keep_completed_starts(monkeypatch):
    interrupt_at(monkeypatch, "scans._basins._find_basins", after=0)
    scene = vi.Scene.ideal(frequency_ratio=1.4, restitution=0.8, gap=2.0, damping_ratio=0.2)
    options = {"resolution": 4, "settle": 10, "longest": 4, "progress": False}
    error = interrupted_by(
        vi.Interrupted, lambda: vi.basins(scene, {"start.Y": (-1.0, 1.0)}, **options)
    )
    assert error.partial["period"].shape == (4,)


def test_all_long_functions_have_the_argument_progress():
    for verb in (
        vi.scan, vi.sweep, vi.basins, vi.integrity_profile, vi.lyapunov, vi.continue_orbit,
        vi.boundary, vi.grazing, vi.minimal_kick, vi.edge_state, vi.manifold,
    ):  # fmt: skip
        option = inspect.signature(verb).parameters["progress"]
        assert option.kind == option.KEYWORD_ONLY and option.default is True


@pytest.mark.slow
def test_interrupted_exponents_use_completed_cycles(monkeypatch):
    """Compare with ln|multiplier|/duration on a periodic motion."""
    scene = vi.Scene.ideal(frequency_ratio=1.4, restitution=0.8, gap=2.0, damping_ratio=0.2)
    whole = vi.lyapunov(scene, scene.start(), 1100)
    assert float(whole.exponents[0]) == pytest.approx(-0.2, rel=1e-6)
    plain = jax.vmap(lambda y: vi.lyapunov(scene, scene.start(Y=y), 1100))(jnp.zeros(1))
    np.testing.assert_allclose(whole.exponents, plain.exponents[0], rtol=1e-11)
    np.testing.assert_allclose(float(whole.state.Y), float(plain.state.Y[0]), rtol=1e-11)
    interrupt_at(monkeypatch, "scans._lyapunov._observe_windows", after=0)
    with pytest.raises(KeyboardInterrupt) as nothing:
        vi.lyapunov(scene, scene.start(), 1100)
    assert not isinstance(nothing.value, vi.Interrupted)
    monkeypatch.undo()
    interrupt_at(monkeypatch, "scans._lyapunov._observe_windows", after=1)
    error = interrupted_by(vi.Interrupted, lambda: vi.lyapunov(scene, scene.start(), 1100))
    assert float(error.partial.exponents[0]) == pytest.approx(-0.2, rel=1e-6)


@pytest.mark.exhaustive
def test_interrupted_searches_for_kicks_and_edges(monkeypatch):
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.02)
    places = ((1.283, 1.007), (1.528, 1.314), (1.26, 1.086))
    one, two, saddle = (vi.find_orbit(scene, scene.start(Y=Y, V=V), 2) for Y, V in places)
    kicks = importlib.import_module("vi_jax.robust._minimal_kick")
    best = kicks.nearest_first
    # Search a second ray, at which the interrupt comes.
    monkeypatch.setattr(kicks, "nearest_first", lambda *arguments: best(*arguments)[:1] * 2)
    interrupt_at(monkeypatch, "robust._minimal_kick._exact", after=1)
    error = interrupted_by(vi.Interrupted, lambda: vi.minimal_kick(scene, one))
    assert error.partial.confirmed and error.partial.exact
    interrupt_at(monkeypatch, "robust._settling.find_orbit", after=0)
    edge = interrupted_by(vi.Interrupted, lambda: vi.edge_state(scene, two, one)).partial
    assert edge.kind == "irregular" and edge.orbit is None and edge.sections.Y.size > 0
    interrupt_at(monkeypatch, "robust._manifold._next_point", after=3)
    found = interrupted_by(vi.Interrupted, lambda: vi.manifold(saddle, length=0.5)).partial
    first, second = found.branches
    assert first.Y.size > 1 and second.Y.size == 1
    assert found.lengths[0] > 0 == found.lengths[1]


@pytest.mark.slow
def test_interrupted_boundaries_grazings_and_profiles(monkeypatch):
    amplitude = 1 / np.hypot(1 - 0.9**2, 10.1 * 0.9)  # x'' + 10.1 x' + x = cos 0.9 t
    machine = vi.machines.Duffing(
        amplitude=1.0, frequency=0.9, damping=10.1, gap=1.1 * amplitude, two_sided=False
    )
    point = grazing_of(machine, "gap", (0.9 * amplitude, 1.2 * amplitude))
    interrupt_at(monkeypatch, "orbit.grazing.simulate_attractors", after=0)
    found = interrupted_by(vi.Interrupted, lambda: vi.grazing(point)).partial
    assert found.machine is None and found.windows is not None
    interrupt_at(monkeypatch, "orbit._follow.advance", after=4)
    options = {"parameter": "amplitude", "bounds": ((0.05, 0.5), (0.5, 2.0))}
    curve = interrupted_by(vi.Interrupted, lambda: vi.boundary(point, **options)).partial
    assert curve.ends == ("interrupted", "interrupted") and len(curve.parameters) > 1
    interrupt_at(monkeypatch, "scans._basins._find_basins", after=1)
    asked = "gap", [1.0, 1.1], {"start.Y": (-0.5, 0.5), "start.V": (-0.5, 0.5)}
    options = {"resolution": 2, "settle": 5, "longest": 4}
    error = interrupted_by(vi.Interrupted, lambda: vi.integrity_profile(machine, *asked, **options))
    assert error.partial["period"].shape == (2, 2, 2)
