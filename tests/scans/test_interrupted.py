"""Long verbs end soon after Ctrl-C, and what they have computed is not lost."""

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
from vi_jax.orbit import curve

from grazings import grazing_of

MOTOR = vi.Parameters().scene(drive="motor")
VALUES = jnp.linspace(0.7, 1.3, 40)


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["sweep", "basins", "long basins", "branch"])
def test_verbs_end_soon(verb):
    """Within two seconds by themselves on two cores (0.02 to 0.1 s, most of what is more being the
    import of xarray); here other tests run beside them, which took basins beyond two."""
    done = subprocess.run(
        [sys.executable, Path(__file__).parent / "interrupted_verbs.py", verb],
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    name, ended, free, share = done.stdout.strip().split(", ")
    assert name == verb and float(ended) < 10 and float(free) < 10, done.stdout
    assert int(share) > 0 or (verb == "long basins" and int(share) == 0), done.stdout


def test_an_interrupted_sweep_gives_the_values_that_were_done(monkeypatch):
    module = importlib.import_module("vi_jax.scans._sweep")
    whole = vi.sweep(MOTOR, "drive.control", VALUES, settle=4, cycles=4)
    assert whole.values.shape == (40,) and bool(whole.successful.all())
    calls, swept = [], module._sweep

    def interrupted(*arguments):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return swept(*arguments)

    monkeypatch.setattr(module, "_sweep", interrupted)
    with pytest.raises(vi.Interrupted, match="the sweep was interrupted") as caught:
        vi.sweep(MOTOR, "drive.control", VALUES, settle=4, cycles=4)
    part = caught.value.partial
    assert isinstance(part, vi.Sweep)
    np.testing.assert_array_equal(part.values, VALUES[:32])
    np.testing.assert_array_equal(part.y_min, whole.y_min[:32])
    np.testing.assert_array_equal(part.sections.W, whole.sections.W[:32])


@pytest.mark.slow
def test_an_interrupted_branch_is_a_branch(monkeypatch):
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.0)
    orbit = vi.find_orbit(scene, scene.start(Y=1.6, V=-1.9), cycles=2)

    def walk(advance, *arguments, **options):
        left = [5]

        def until(*places):
            left[0] -= 1
            if left[0] < 0:
                raise KeyboardInterrupt
            return advance(*places)

        return curve.walk(until, *arguments, **options)

    monkeypatch.setattr(importlib.import_module("vi_jax.orbit._walked"), "walk", walk)
    with pytest.raises(vi.Interrupted) as caught:
        vi.continue_orbit(orbit, parameter="stops.0.gap", bounds=(1.5, 2.5))
    part = caught.value.partial
    assert isinstance(part, vi.Branch) and part.ends == ("interrupted", "interrupted")
    assert 2 <= len(part.parameter) <= 6 and part.parameter[0] == pytest.approx(2.0)
    assert bool(part.orbit(-1).successful)


@pytest.mark.slow
def test_interrupted_basins_keep_the_starts_that_were_followed(monkeypatch):
    module = importlib.import_module("vi_jax.scans._basins")

    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "sorted_out", interrupted)
    scene = vi.Scene.ideal(frequency_ratio=1.4, restitution=0.8, gap=2.0, damping_ratio=0.2)
    with pytest.raises(vi.ScanInterrupted) as caught:
        vi.basins(
            scene, {"start.Y": (-1.0, 1.0)}, resolution=4, settle=10, longest=4, progress=False
        )
    assert caught.value.data["period"].shape == (4,)
    assert caught.value.partial is caught.value.data


VERBS = [
    vi.scan, vi.sweep, vi.basins, vi.integrity_profile, vi.lyapunov, vi.continue_orbit, vi.boundary,
    vi.grazing, vi.minimal_kick, vi.edge_state, vi.manifold,
]  # fmt: skip


@pytest.mark.parametrize("verb", VERBS, ids=lambda verb: verb.__name__)
def test_all_long_verbs_have_one_option_for_their_bar(verb):
    option = inspect.signature(verb).parameters["progress"]
    assert option.kind == option.KEYWORD_ONLY and option.default is True


def struck(monkeypatch, place, after):
    """Ctrl-C at the call of a function that comes after so many others."""
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


@pytest.mark.slow
def test_interrupted_exponents_are_those_of_fewer_cycles(monkeypatch):
    """On a periodic motion, whose exponents are ln|multiplier|/duration."""
    scene = vi.Scene.ideal(frequency_ratio=1.4, restitution=0.8, gap=2.0, damping_ratio=0.2)
    whole = vi.lyapunov(scene, scene.start(), 1100)
    assert float(whole.exponents[0]) == pytest.approx(-0.2, rel=1e-6)
    plain = jax.vmap(lambda y: vi.lyapunov(scene, scene.start(Y=y), 1100))(jnp.zeros(1))
    np.testing.assert_allclose(whole.exponents, plain.exponents[0], rtol=1e-11)
    np.testing.assert_allclose(float(whole.state.Y), float(plain.state.Y[0]), rtol=1e-11)
    struck(monkeypatch, "scans._lyapunov._part", after=0)
    with pytest.raises(KeyboardInterrupt) as nothing:
        vi.lyapunov(scene, scene.start(), 1100)
    assert not isinstance(nothing.value, vi.Interrupted)
    monkeypatch.undo()
    struck(monkeypatch, "scans._lyapunov._part", after=1)
    with pytest.raises(vi.Interrupted) as caught:
        vi.lyapunov(scene, scene.start(), 1100)
    assert float(caught.value.partial.exponents[0]) == pytest.approx(-0.2, rel=1e-6)


SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.02)


@pytest.fixture(scope="module")
def motions():
    """Two that attract, and a saddle between them."""
    places = ((1.283, 1.007), (1.528, 1.314), (1.26, 1.086))
    return [vi.find_orbit(SCENE, SCENE.start(Y=Y, V=V), 2) for Y, V in places]


@pytest.mark.exhaustive
def test_interrupted_searches_for_kicks_and_edges(monkeypatch, motions):
    one, two, saddle = motions
    look = importlib.import_module("vi_jax.robust._minimal_kick").Look
    best = look.best
    # A second ray to be interrupted at, whichever there are.
    monkeypatch.setattr(look, "best", lambda *arguments: best(*arguments)[:1] * 2)
    struck(monkeypatch, "robust._minimal_kick.exact", after=1)
    with pytest.raises(vi.Interrupted) as caught:
        vi.minimal_kick(SCENE, one)
    assert caught.value.partial.confirmed and caught.value.partial.exact
    struck(monkeypatch, "robust._edge_state.orbit_near", after=0)
    with pytest.raises(vi.Interrupted) as caught:
        vi.edge_state(SCENE, two, one)
    edge = caught.value.partial
    assert edge.kind == "irregular" and edge.orbit is None and edge.sections.Y.size > 0
    struck(monkeypatch, "robust._manifold._ahead", after=3)
    with pytest.raises(vi.Interrupted) as caught:
        vi.manifold(saddle, length=0.5)
    first, second = caught.value.partial.branches
    assert first.Y.size > 1 and second.Y.size == 1
    assert caught.value.partial.lengths[0] > 0 == caught.value.partial.lengths[1]


@pytest.mark.exhaustive
def test_interrupted_boundaries_grazings_and_profiles(monkeypatch):
    amplitude = 1 / np.hypot(1 - 0.9**2, 10.1 * 0.9)  # of x'' + 10.1 x' + x = cos 0.9 t
    machine = vi.machines.Duffing(
        amplitude=1.0, frequency=0.9, damping=10.1, gap=1.1 * amplitude, two_sided=False
    )
    point = grazing_of(machine, "gap", (0.9 * amplitude, 1.2 * amplitude))
    struck(monkeypatch, "orbit._beside_grazing.simulated", after=0)
    with pytest.raises(vi.Interrupted) as caught:
        vi.grazing(point)
    assert caught.value.partial.machine is None and caught.value.partial.windows is not None
    struck(monkeypatch, "orbit._curve_monitor.advance", after=4)
    with pytest.raises(vi.Interrupted) as caught:
        vi.boundary(point, parameter="amplitude", bounds=((0.05, 0.5), (0.5, 2.0)))
    curve = caught.value.partial
    assert curve.ends == ("interrupted", "interrupted") and len(curve.parameters) > 1
    struck(monkeypatch, "scans._integrity.sorted_out", after=1)
    region = {"start.Y": (-1.0, 1.0), "start.V": (-1.0, 1.0)}
    with pytest.raises(vi.ScanInterrupted) as caught:
        vi.integrity_profile(
            SCENE, "stops.0.gap", [2.0, 2.1], region, resolution=2, settle=5, longest=4
        )
    assert caught.value.partial["period"].shape == (2, 2, 2)
