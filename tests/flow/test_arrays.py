"""States with array components, compared with the same machine in scalar components."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

PI = np.pi


class Rows(eqx.Module):
    q: Any
    v: Any


class Numbers(eqx.Module):
    x: Any
    y: Any
    u: Any
    w: Any


def rows(x, y, u, w):
    return Rows(jnp.stack([x, y]), jnp.stack([u, w]))


def one_array(x, y, u, w):
    return jnp.stack([x, y, u, w])


class Chain(vi.AbstractMachine):
    """Two masses on springs; a force drives the first one against a stop."""

    made: Any = eqx.field(static=True)
    gap: Any = 0.6

    def parts(self, state):
        return jnp.concatenate([jnp.atleast_1d(x) for x in jax.tree.leaves(state)])

    def position(self, state):
        return self.parts(state)[0]

    def velocity(self, state):
        return self.parts(state)[2]

    def placed(self, state, Y, V):
        _, y, _, w = self.parts(state)
        return self.made(Y, y, V, w)

    @property
    def contacts(self):
        return (vi.RigidStop(self.gap, 0.7),)

    cycle = 2 * PI / 0.8

    def field(self, s, state):
        x, y, u, w = self.parts(state)
        force = jnp.cos(0.8 * s) - 0.1 * u
        return self.made(u, w, force - x + 0.5 * (y - x), -0.1 * w - y + 0.5 * (x - y))

    def start(self):
        return self.made(*map(jnp.asarray, (0.1, -0.2, 0.3, 0.0)))


def table(state):
    """Return the scalar components as an array with one state per row."""
    return np.stack([np.asarray(x) for x in jax.tree.leaves(state)], axis=-1)


def flat(state):
    return np.concatenate([np.asarray(x) for x in jax.tree.leaves(state)], axis=-1)


@pytest.fixture(scope="module")
def plain():
    machine = Chain(Numbers)
    return machine, vi.simulate(machine, machine.start(), 3, samples=4, estimate=True)


@pytest.mark.slow
@pytest.mark.parametrize("made", [rows, one_array])
def test_run_with_arrays_equals_run_with_scalars(made, plain):
    machine, wanted = Chain(made), plain[1]
    run = vi.simulate(machine, machine.start(), 3, samples=4, estimate=True)

    last = table(wanted.last)
    assert int(wanted.impacts.sum()) > 2
    np.testing.assert_allclose(flat(run.last), last, rtol=0, atol=1e-12)
    np.testing.assert_allclose(flat(run.sections), table(wanted.sections), rtol=0, atol=1e-12)
    np.testing.assert_allclose(flat(run.samples.state), table(wanted.samples.state), atol=1e-12)
    data = run.to_xarray()
    names = ("section_q", "section_v") if made is rows else ("section_state",)
    assert all(data[name].dims[0] == "section" and data[name].ndim == 2 for name in names)
    found = np.concatenate([data[name] for name in names], axis=1)
    np.testing.assert_array_equal(found, flat(run.sections))
    word = "q[1] = " if made is rows else "[1] = "
    assert f"{word}{last[1]:.9g}" in str(run)
    column = run.to_xarray(along="section").to_dataframe()[f"{names[0]}[1]"]
    np.testing.assert_array_equal(column, flat(run.sections)[:, 1])


def test_vmap_with_arrays_equals_vmap_with_scalars(plain):
    gaps = jnp.asarray([0.5, 0.6, 0.9])

    def last(made):
        def one(gap):
            return vi.simulate(Chain(made, gap), Chain(made).start(), 3)

        return vi.jit(jax.vmap(one))(gaps)

    run, wanted = last(rows), table(last(Numbers).last)
    assert run.last.q.shape == run.last.v.shape == (3, 2)
    np.testing.assert_allclose(np.concatenate([run.last.q, run.last.v], axis=1), wanted, atol=1e-12)
    np.testing.assert_allclose(wanted[1], table(plain[1].last), atol=1e-12)
    assert dict(run.to_xarray(["gap"]).sizes) == {
        "gap": 3, "section": 4, "q_0": 2, "v_0": 2, "cycle": 3,
    }  # fmt: skip


@pytest.mark.slow
def test_cycle_map_and_lyapunov_exponents(plain):
    machine = Chain(rows)
    the_map = vi.cycle_map(machine)
    end = the_map(machine.start())
    wanted = table(plain[1].sections)[1]
    np.testing.assert_allclose(np.concatenate([end.q, end.v]), wanted, atol=1e-9)
    # In each cycle damping multiplies the phase volume by exp(-0.2 T), and each impact by k².
    impacts = np.asarray(vi.simulate(machine, machine.start(), 16, settle=200).impacts)
    assert np.ptp(impacts) == 0
    found = vi.lyapunov(machine, machine.start(), 16, settle=200)
    volume = -0.2 * machine.cycle + 2 * np.log(0.7) * impacts[0]
    assert found.exponents.shape == (4,) and float(found.per_cycle.sum()) == pytest.approx(volume)


MACHINE = Chain(rows)


@pytest.mark.slow
def test_orbits_sweeps_scans_and_basins_agree_with_runs_of_scalars():
    plain = Chain(Numbers)
    end = vi.simulate(plain, plain.start(), 1, settle=200).last
    orbit = vi.find_orbit(MACHINE, rows(end.x, end.y, end.u, end.w), throw=True)
    np.testing.assert_allclose(np.append(orbit.state.q, orbit.state.v), table(end), atol=1e-11)
    many = vi.find_orbit(MACHINE, jax.tree.map(lambda x: jnp.stack([x, x]), orbit.state))
    np.testing.assert_allclose(many.state.q, [orbit.state.q, orbit.state.q], rtol=0, atol=1e-10)

    def run(gap, y):
        start = dataclasses.replace(plain.start(), y=y)
        return vi.simulate(Chain(Numbers, gap), start, 4, settle=20)

    gaps, places = (x.ravel() for x in np.meshgrid([0.5, 0.6], [0.0, 0.1], indexing="ij"))
    runs = vi.jit(jax.vmap(run))(gaps, places)
    given = {"start": MACHINE.start(), "settle": 20, "cycles": 4, "progress": False}
    axes, measure = {"gap": [0.5, 0.6], "start.q[1]": [0.0, 0.1]}, ("extremes", vi.Sections(2))
    scan = vi.scan(MACHINE, axes, measure=measure, **given)
    least = np.min(runs.y_min, axis=1).reshape(2, 2)
    np.testing.assert_allclose(scan.y_min, least, rtol=0, atol=1e-11)
    for ours, theirs in {"q[0]": "x", "q[1]": "y", "v[0]": "u", "v[1]": "w"}.items():
        last = np.reshape(getattr(runs.sections, theirs)[:, -2:], (2, 2, 2))
        np.testing.assert_allclose(scan[ours], last, rtol=0, atol=1e-11)
    sweep = vi.sweep(MACHINE, "gap", [0.6], settle=200, cycles=4)
    # The search ends at a residual of 2e-11 here.
    np.testing.assert_allclose(sweep.y_min[0], orbit.y_min, rtol=0, atol=3e-11)
    basins = vi.basins(MACHINE, {"start.q[1]": (-0.5, 0.5)}, resolution=4, longest=8)
    (basin,) = basins.attractors
    assert (basin.starts, basin.period) == (4, 1)
    for name, value in zip(("q[0]", "q[1]", "v[0]", "v[1]"), table(end), strict=True):
        np.testing.assert_allclose(basin.sections[name], value, rtol=0, atol=1e-7)
    branch = vi.continue_orbit(orbit, parameter="gap", bounds=(0.58, 0.62), step=0.02)
    np.testing.assert_allclose(branch.y_max, branch.parameter, atol=1e-10)


@pytest.mark.slow
def test_what_follows_a_grazing_with_arrays_is_as_with_scalars():
    found = []
    for machine in (Chain(Numbers), MACHINE):
        orbit = vi.find_orbit(machine, vi.simulate(machine, settle=200).last)
        branch = vi.continue_orbit(orbit, parameter="gap", bounds=(0.5, 3.0), progress=False)
        point = next(x for x in branch.special if x.kind == "grazing")
        graze = vi.grazing(point, check=False)
        found.append((str(graze.outcome), [point.parameter, *graze.entries]))
    assert found[0][0] == found[1][0]
    np.testing.assert_allclose(found[0][1], found[1][1], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "call",
    [
        lambda: vi.sweep(MACHINE, "q", [0.5, 0.6]),
        lambda: vi.scan(MACHINE, {"start.q": [0.5, 0.6]}, progress=False),
        lambda: vi.scan(MACHINE, {"start.q[2]": [0.5, 0.6]}, progress=False),
    ],
)
def test_names_that_are_not_scalars_of_the_state_raise(call):
    with pytest.raises(ValueError, match=r"must be .*number of the machine"):
        call()


def test_invalid_states_raise():
    empty = Rows(jnp.zeros(2), jnp.zeros((2, 0)))
    for call in (vi.simulate, vi.find_orbit):
        with pytest.raises(ValueError, match=r"must hold numbers, but its v has shape \(2, 0\)"):
            call(MACHINE, empty, 3)
    many = Numbers(*jnp.zeros((4, 5)))

    class Apart(Chain):
        def position(self, state):
            return state.x

        def velocity(self, state):
            return state.u

    with pytest.raises(ValueError, match=r"`start` must be one state .* shape \(5,\)"):
        vi.simulate(Apart(Numbers), many, 3)

    class Plain(vi.AbstractMachine):
        cycle = 1.0

        def field(self, t, z):
            return {"x": -z.x}

    three = vi.State(x=jnp.ones(3))
    with pytest.raises(ValueError, match=r"`def position\(self, z\): return z.x\[0\]` in a Plain"):
        vi.simulate(Plain(), three, 1)

    class Cured(Plain):
        position = velocity = lambda self, z: z.x[0]

    np.testing.assert_allclose(vi.simulate(Cured(), three, 1).last.x, np.exp(-1), rtol=1e-12)


MASSES = 18
METHOD = vi.FixedStep(steps_per_cycle=40)


class Row(vi.AbstractMachine):
    """Chain of masses on springs and dampers; a force drives the first, a stop limits the last."""

    springs: Any
    force: Any = 1.0

    @property
    def contacts(self):
        return vi.RigidStop(0.5, 0.8, on=("x[-1]", "v[-1]"))

    cycle = 2 * jnp.pi / 0.4

    def field(self, s, state):
        x, v = state.x, state.v
        y = x + 0.1 * v
        push = self.force * jnp.cos(0.4 * s)
        pull = self.springs * jnp.diff(y, prepend=0.0)
        return {"x": v, "v": (jnp.append(pull[1:], 0.0) - pull).at[0].add(push)}

    def start(self):
        return vi.State(x=jnp.zeros(self.springs.shape), v=jnp.zeros(self.springs.shape))


SPRINGS = jnp.linspace(1.0, 2.0, MASSES)


@pytest.mark.slow
def test_derivatives_with_respect_to_arrays_match_differences():
    def loss(springs):
        machine = Row(springs)
        run = vi.simulate(machine, machine.start(), 3, method=METHOD)
        return jnp.sum(run.last.x * jnp.arange(MASSES)) + run.y_min[-1]

    gradient, way = jax.grad(loss)(SPRINGS), jnp.cos(jnp.arange(MASSES))
    _, along = jax.jvp(loss, (SPRINGS,), (way,))
    np.testing.assert_allclose(gradient @ way, along, rtol=1e-10)
    step = 1e-6
    slope = (loss(SPRINGS + step * way) - loss(SPRINGS - step * way)) / (2 * step)
    np.testing.assert_allclose(along, slope, rtol=1e-6)


def test_state_of_a_thousand_numbers():
    """The wave from the first mass has not reached the last one, which is still at rest."""
    machine = Row(jnp.ones(500), force=0.0)
    still, method = machine.start(), vi.FixedStep(steps_per_cycle=60)
    start = still.replace(v=still.v.at[0].set(1.0))
    run = vi.simulate(machine, start, 1, method=method)
    q, v = np.asarray(run.last.x), np.asarray(run.last.v)
    assert bool(run.successful) and abs(q[-1]) < 1e-12 and np.abs(v).max() > 0.05
    rest = vi.simulate(machine, still, 1, method=method)
    np.testing.assert_array_equal(flat(rest.last), 0.0)
