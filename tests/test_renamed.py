"""Old names are refused with the one that took their place."""

import jax.numpy as jnp
import pytest
import vi_jax as vi

SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("AbstractScene", "AbstractMachine"),
        ("AbstractSearch", "AbstractRootFinder"),
        ("road", "backend"),
    ],
)
def test_names_of_the_package(old, new):
    with pytest.raises(AttributeError, match=f"`vi_jax.{old}` is called `vi_jax.{new}` now"):
        getattr(vi, old)
    assert hasattr(vi, new)


@pytest.mark.parametrize(
    "call",
    [
        vi.simulate, vi.find_orbit, vi.suggest_method, vi.preset, vi.cycle_map, vi.scan, vi.sweep,
        vi.basins, vi.lyapunov,
    ],
)  # fmt: skip
def test_arguments(call):
    with pytest.raises(TypeError, match=rf"`scene` of `{call.__name__}` is called `machine` now"):
        call(scene=SCENE)


def test_attributes_of_an_orbit():
    state = vi.OscillatorState(jnp.asarray(-5.263157894736842), jnp.asarray(0.0))
    orbit = vi.find_orbit(vi.Scene.ideal(frequency_ratio=0.9, gap=20.0), state)
    with pytest.raises(AttributeError, match="`scene` of a `Orbit` is called `machine` now"):
        orbit.scene  # noqa: B018
    with pytest.raises(AttributeError, match="no attribute `speed`"):
        orbit.speed  # noqa: B018
