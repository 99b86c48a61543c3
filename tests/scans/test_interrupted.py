"""Long functions end soon after Ctrl-C, and keep their results."""

import importlib
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

MOTOR = vi.Parameters().scene(drive="motor")
VALUES = jnp.linspace(0.7, 1.3, 40)


def interrupt_at(monkeypatch, place, after):
    """Raise `KeyboardInterrupt` at the call of a function after `after` calls."""
    path, _, name = f"vi_jax.{place}".rpartition(".")
    module = importlib.import_module(path)
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


def test_an_interrupted_sweep_keeps_completed_values(monkeypatch):
    whole = vi.sweep(MOTOR, "drive.control", VALUES, settle=4, cycles=4)
    assert whole.values.shape == (40,) and bool(whole.successful.all())
    interrupt_at(monkeypatch, "scans._sweep._sweep", after=2)
    call = lambda: vi.sweep(MOTOR, "drive.control", VALUES, settle=4, cycles=4)
    error = interrupted_by(vi.Interrupted, call)
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

    interrupt_at(monkeypatch, "orbit.walk.advance", after=5)
    options = {"parameter": "stops.0.gap", "bounds": (1.5, 2.5)}
    part = interrupted_by(vi.Interrupted, lambda: vi.continue_orbit(orbit, **options)).partial
    assert isinstance(part, vi.Branch) and part.ends == ("interrupted", "interrupted")
    assert 2 <= len(part.parameter) <= 6 and part.parameter[0] == pytest.approx(2.0)
    assert bool(part.orbit(-1).successful)


@pytest.mark.slow
def test_interrupted_basins_keep_completed_starts(monkeypatch):
    interrupt_at(monkeypatch, "scans._basins._last_sections", after=0)
    scene = vi.Scene.ideal(frequency_ratio=1.4, restitution=0.8, gap=2.0, damping_ratio=0.2)
    options = {"resolution": 4, "settle": 10, "longest": 4, "progress": False}
    call = lambda: vi.basins(scene, {"start.Y": (-1.0, 1.0)}, **options)
    error = interrupted_by(vi.Interrupted, call)
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
