"""Single-precision numbers in a double-precision session, and the reverse."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

NUMBERS = {"frequency_ratio": 0.9, "restitution": 0.7, "gap": 0.6, "damping_ratio": 0.05}


@pytest.mark.slow
def test_single_precision_scene_is_promoted_with_a_warning():
    with jax.enable_x64(False):
        early = vi.Scene.ideal(**NUMBERS)
        started = early.start(Y=-0.3)
    late = vi.Scene.ideal(**{n: float(np.float32(x)) for n, x in NUMBERS.items()})
    start = late.start(Y=float(np.float32(-0.3)))

    def last(scene, start):
        return vi.simulate(scene, start, 3, method=vi.FixedStep()).last.Y

    expected = jax.jvp(lambda s: last(late, s), (start,), (start,))
    with pytest.warns(UserWarning, match="stops.*gap.*double precision"):
        found = jax.jvp(lambda s: last(early, s), (start,), (start,))
    assert found[0].dtype == jnp.float64
    np.testing.assert_array_equal(found, expected)
    for scene in (late, early):  # the second has no double-precision number
        with pytest.warns(UserWarning, match="`start`.*double precision"):
            np.testing.assert_array_equal(last(scene, started), expected[0])


@pytest.mark.parametrize("single", [np.float32, jnp.float32])
def test_single_precision_argument_warns_with_its_name(single):
    with pytest.warns(UserWarning, match="`gap`.*double precision"):
        scene = vi.Scene.ideal(**{**NUMBERS, "gap": single(0.6)})
    assert scene.stops[0].gap.dtype == jnp.float64
    with pytest.warns(UserWarning, match="`Y`.*double precision"):
        assert scene.start(Y=single(0.1)).Y.dtype == jnp.float64


def test_double_precision_scene_raises_in_single_precision():
    scene, swept = vi.Scene.ideal(**NUMBERS), {"drive.frequency_ratio": [0.9, 1.0]}
    start = scene.start(Y=-0.3)
    with jax.enable_x64(False):
        for call in (
            lambda: vi.simulate(scene, start, 2),
            lambda: vi.find_orbit(scene, start),
            lambda: vi.sweep(scene, *swept, *swept.values(), start=start),
            lambda: vi.scan(scene, swept, measure="extremes", cycles=2),
        ):
            with pytest.raises(TypeError, match=r"`machine` must be of single precision, .*gap"):
                call()
        early = vi.Scene.ideal(**NUMBERS)
        with pytest.raises(TypeError, match=r"`start` .* double precision \(Y, V\)"):
            vi.simulate(early, start, 2)


@pytest.mark.slow
def test_single_precision_warns_once_and_cannot_continue_orbits():
    """A search runs several programs. The corrector of a branch needs a tolerance of 1e-11."""
    with jax.enable_x64(False), warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        scene = vi.Scene.ideal(frequency_ratio=0.9)
        orbit = vi.find_orbit(scene, scene.start(Y=1.6, V=-1.9), cycles=2)
        assert [str(x.message)[:37] for x in told] == ["vi_jax is running in single precision"]
        with pytest.raises(ValueError, match="`orbit` must be of double precision"):
            vi.continue_orbit(orbit, parameter="stops.0.gap", bounds=(1.9, 2.1))
