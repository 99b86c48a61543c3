"""Results as labelled data sets and as tables."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=1.0, damping_ratio=0.05)
ZETA = "drive.frequency_ratio"


def test_a_run_in_tables():
    cycles, samples, log = 20, 8, 6
    run = vi.simulate(SCENE, SCENE.start(), cycles, samples=samples, impact_log=log)
    impacts = int(run.impacts.sum())
    assert impacts > cycles / 2
    rows = {"cycle": cycles, "section": cycles + 1, "sample": cycles * samples + 1,
            "impact": impacts}  # fmt: skip
    tables = {name: run.to_xarray(along=name).to_dataframe() for name in rows}
    assert {name: len(table) for name, table in tables.items()} == rows
    assert tables["cycle"].y_max.tolist() == run.y_max.tolist()
    assert tables["section"].section_V.tolist() == run.sections.V.tolist()
    assert tables["sample"].sample_Y.tolist() == run.samples.state.Y.tolist()
    counts = tables["impact"].groupby("cycle").size()
    assert counts.to_dict() == {i + 1: n for i, n in enumerate(run.impacts.tolist()) if n}
    met = np.asarray(run.impact_log.stop) >= 0
    assert tables["impact"].log_speed.tolist() == np.asarray(run.impact_log.speed)[met].tolist()
    # Each variable is in a table, or is a scalar.
    everything = run.to_xarray()
    told = {str(name) for name in rows for name in run.to_xarray(along=name)}
    assert told == {name for name, x in everything.items() if x.ndim}
    with pytest.raises(ValueError, match=r"`along` must be one of 'section', .*got 'cycles'"):
        run.to_xarray(along="cycles")


def test_a_batch_in_tables():
    def one(gap):
        scene = vi.Scene.ideal(frequency_ratio=0.9, gap=gap, damping_ratio=0.05)
        return vi.simulate(scene, scene.start(), 3, impact_log=4)

    run = jax.vmap(one)(jnp.asarray([0.8, 1.0, 1.2]))
    table = run.to_xarray(["gap"], along="impact").to_dataframe()
    assert table.groupby("gap").size().tolist() == run.impacts.sum(axis=1).tolist()
    with pytest.raises(ValueError, match=r"`dims` must name the 1 batch axes .* 'gap'"):
        run.to_xarray("gap")
    lanes = run.to_xarray(["gap"], along="gap").to_dataframe()
    assert lanes.result.tolist() == ["successful"] * 3
    assert lanes.steps.tolist() == run.steps.tolist()


def test_a_sweep_and_its_exponents():
    values = np.linspace(0.8, 1.2, 4)
    sweep = vi.sweep(SCENE, ZETA, values, settle=20, cycles=6)
    data = sweep.to_xarray()
    assert dict(data.sizes) == {"value": 4, "cycle": 6}
    np.testing.assert_array_equal(data[ZETA], values)
    np.testing.assert_array_equal(data.section_V, sweep.sections.V)
    assert data.y_min.attrs["units"] == "a" and data[ZETA].attrs["units"] == "ω"
    assert "chaotic" in data.period.attrs["flag_meanings"]
    table = sweep.to_xarray(along="value").to_dataframe()
    assert table.y_min.tolist() == sweep.y_min.tolist() and table[ZETA].tolist() == values.tolist()
    assert len(sweep.to_xarray(along="cycle").to_dataframe()) == 24
    found = vi.Lyapunov(
        jnp.asarray([0.1, -0.3]), jnp.asarray([0.2, -0.6]), jnp.asarray(0.01), SCENE.start(Y=0.7),
        vi.RESULTS.successful, unit="ω",
    )  # fmt: skip
    table = found.to_xarray()
    assert table.exponents.dims == ("exponent",) and table.result.item() == "successful"
    assert table.exponents.attrs["units"] == "ω" and float(table.state_Y) == 0.7
    both = jax.tree.map(lambda x: jnp.stack([x, x]), (sweep, found))
    assert dict(both[0].to_xarray(["ξ"]).sizes) == {"ξ": 2, "value": 4, "cycle": 6}
    assert dict(both[1].to_xarray().sizes) == {"lane": 2, "exponent": 2}
