"""Long verbs end soon after Ctrl-C, and what they have computed is not lost."""

import importlib
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.orbit import curve

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
    module = importlib.import_module("vi_jax.scan._sweep")
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

    monkeypatch.setattr(importlib.import_module("vi_jax.orbit.branch"), "walk", walk)
    with pytest.raises(vi.Interrupted) as caught:
        vi.continue_orbit(orbit, parameter="stops.0.gap", bounds=(1.5, 2.5))
    part = caught.value.partial
    assert isinstance(part, vi.Branch) and part.ends == ("interrupted", "interrupted")
    assert 2 <= len(part.parameter) <= 6 and part.parameter[0] == pytest.approx(2.0)
    assert bool(part.orbit(-1).successful)


@pytest.mark.slow
def test_interrupted_basins_keep_the_starts_that_were_followed(monkeypatch):
    module = importlib.import_module("vi_jax.scan._basins")

    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "_sorted_out", interrupted)
    scene = vi.Scene.ideal(frequency_ratio=1.4, restitution=0.8, gap=2.0, damping_ratio=0.2)
    with pytest.raises(vi.ScanInterrupted) as caught:
        vi.basins(
            scene, {"start.Y": (-1.0, 1.0)}, resolution=4, settle=10, longest=4, progress=False
        )
    assert caught.value.data["period"].shape == (4,)
    assert caught.value.partial is caught.value.data
