"""Noise in scans and sweeps: paths of lanes, stores, and programs without noise."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
import xarray as xr
from vi_jax.flow import RunOptions
from vi_jax.scans import make_program
from vi_jax.scans.program import LANE

SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.7, gap=1.5, damping_ratio=0.1)
NOISE, KEY = vi.WhiteNoise({"V": 0.1}, impulses=16), jax.random.key(3)
AXES = {"noise.V": [0.05, 0.1], "noise.path": np.arange(300)}


def scan_with(**options):
    given = {
        "measure": ("sections", "extremes"), "settle": 3, "cycles": 16, "noise": NOISE,
        "key": KEY, "progress": False, "lanes": 256, "workers": 1,
    }  # fmt: skip
    return vi.scan(SCENE, AXES, **(given | options))


@pytest.fixture(scope="module")
def whole():
    return scan_with().load()


@pytest.mark.slow
def test_a_lane_equals_the_run_with_its_key(whole):
    for row, path in ((0, 7), (1, 211)):
        noise = vi.WhiteNoise({"V": AXES["noise.V"][row]}, impulses=16)
        key = jax.random.fold_in(KEY, 300 * row + path)
        run = vi.simulate(SCENE, SCENE.start(), 16, settle=3, noise=noise, key=key)
        assert np.array_equal(run.sections.V[1:], whole.V[row, path])
        assert run.y_min is not None
        assert np.array_equal(jnp.min(run.y_min), whole.y_min[row, path])
    assert len(np.unique(whole.V[..., -1])) == 600


def test_paths_do_not_depend_on_blocks_workers_or_threads(whole):
    with vi.threads(1):
        other = scan_with(lanes=512, workers=2)
    xr.testing.assert_identical(other, whole)
    assert np.any(scan_with(key=jax.random.key(4)).V != whole.V)


def test_a_store_rejects_another_noise(whole, tmp_path):
    data = scan_with(store=tmp_path / "s")
    assert np.array_equal(data.V, whole.V) and '"impulses": 16' in data.noise
    for other, word in (
        ({"key": jax.random.key(4)}, "noise key"),
        ({"noise": vi.WhiteNoise({"V": 0.1}, impulses=32)}, "noise impulses"),
        ({"noise": None, "key": None}, "noise"),
    ):
        with pytest.raises(ValueError, match=f"in .* the {word} is|`axes`, which names"):
            scan_with(store=tmp_path / "s", **other)


def test_a_store_rejects_another_amplitude_function(tmp_path):
    def scan(factor):
        noise = vi.WhiteNoise({"V": lambda state: factor * state.Y}, impulses=16)
        given = {"settle": 1, "cycles": 4, "noise": noise, "key": KEY, "progress": False}
        return vi.scan(
            SCENE, {"noise.path": [0, 1]}, measure="extremes", store=tmp_path / "s", **given
        )

    first = scan(0.1).load()
    assert np.array_equal(scan(0.1).y_min, first.y_min)
    with pytest.raises(ValueError, match="the code of noise is"):
        scan(0.2)


@pytest.mark.slow
def test_derivatives_with_respect_to_an_amplitude(whole):
    axes = {"noise.V": [0.05], "noise.path": [0]}
    found, step = {}, 1e-6
    given = {"measure": "sections", "settle": 3, "cycles": 16, "noise": NOISE, "key": KEY}
    for change in (-step, 0.0, step):
        axes["noise.V"] = [0.05 + change]
        found[change] = vi.scan(SCENE, axes, **given, derivatives="noise.V", progress=False)
    differences = (found[step].V.values - found[-step].V.values) / (2 * step)
    np.testing.assert_allclose(found[0.0].d_V.squeeze(), differences.squeeze(), rtol=1e-5)


def test_programs_without_noise_have_no_random_numbers():
    """Random numbers are made from unsigned 32-bit integers."""

    def program(**noise):
        made = make_program(SCENE, ("start.Y",), RunOptions(), measure="extremes", **noise)
        numbers, rest = eqx.partition(made, eqx.is_array)
        values = {"start.Y": jnp.zeros(4)}
        if noise:
            values[LANE] = jnp.arange(4, dtype=jnp.uint32)
        return str(
            jax.make_jaxpr(lambda n: eqx.combine(n, rest)(values, jnp.ones(4, bool)))(numbers)
        )

    assert "u32[" not in program()
    assert "u32[" in program(noise=NOISE, key=KEY)


def test_a_sweep_uses_a_key_for_each_value():
    values = np.linspace(0.8, 1.0, 5)
    options = {"cycles": 4, "settle": 4, "noise": NOISE, "key": KEY}
    sweep = vi.sweep(SCENE, "drive.frequency_ratio", values, **options)
    state = SCENE.start()
    for n in range(values.size):
        here = vi.Scene.ideal(
            frequency_ratio=values[n], restitution=0.7, gap=1.5, damping_ratio=0.1
        )
        options["key"] = jax.random.fold_in(KEY, n)
        run = vi.simulate(here, state, **options)
        np.testing.assert_allclose(sweep.sections.V[n], run.sections.V[1:], atol=1e-12)
        state = run.last
    assert np.all(sweep.period == vi.REGIMES.unsettled)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"measure": "regime"}, "must not contain Regime with noise"),
        ({"measure": "exponent"}, "must not contain Exponent"),
        ({"noise": 0.5}, "must be a `WhiteNoise`"),
        ({"key": None}, "Argument `key` must be one key"),
        ({"noise": None}, "Argument `key` needs noise"),
        ({"noise": None, "key": None}, "names 'noise.V', needs noise"),
        ({"noise": vi.WhiteNoise({"W": 0.5})}, r"\(noise.W, noise.path\), but got 'noise.V'"),
        ({"derivatives": "noise.path"}, r"number of the noise \(noise.V\), but got 'noise.path'"),
    ],
)
def test_invalid_arguments_raise(options, message):
    with pytest.raises((TypeError, ValueError), match=message):
        scan_with(**options)


@pytest.mark.parametrize(
    "machine, noise, message",
    [
        (vi.machines.ReliefValve(flow_rate=5.0), vi.WhiteNoise({"speed": 0.1}), "observed_every"),
        (SCENE, vi.WhiteNoise({"Y": 0.1}), "must change velocities only"),
    ],
)
def test_noise_that_does_not_fit_the_machine_raises(machine, noise, message):
    given = {"noise": noise, "key": KEY, "settle": 1, "cycles": 4}
    with pytest.raises(ValueError, match=message):
        vi.scan(machine, {"noise.path": [0, 1]}, measure="extremes", progress=False, **given)
    with pytest.raises(ValueError, match=message):
        name = "restitution" if hasattr(machine, "restitution") else "stops.0.restitution"
        vi.sweep(machine, name, [0.5], **given)
