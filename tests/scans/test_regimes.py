"""Regimes of a scan: periodic, chaotic, transient and unsettled motions."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.orbit import MotionSections, agreement, checked_rotation_number, rotation_number
from vi_jax.scans.measures import least_period

from kicked import Alternating, Ring, at, rotation_of

SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.01)


def _regimes_of(lanes, settle):
    zeta, k, xi = np.array(lanes).T
    axes = {
        "drive.frequency_ratio": zeta, "stops.0.restitution": k, "damping_ratio": xi,
    }  # fmt: skip
    return vi.scan(SCENE, axes, measure="regime", settle=settle, paired=True)


@pytest.mark.slow
def test_an_undamped_motion_has_two_frequencies():
    """Its section turns by 1/ratio in each cycle: at 0.77 it repeats after 77 cycles."""
    free, ratios = vi.Scene.ideal(frequency_ratio=0.77, gap=None), [0.77, 1 / np.sqrt(3)]
    options: Any = {"measure": ("regime", "rotation"), "settle": 10, "progress": False}
    data = vi.scan(free, {"drive.frequency_ratio": ratios, "start.Y": [0.3]}, **options)
    assert data.period.values.tolist() == [[vi.REGIMES.unsettled], [vi.REGIMES.quasiperiodic]]
    np.testing.assert_allclose(data.rotation.values[:, 0], [23 / 77, 2 - np.sqrt(3)], atol=1e-9)
    longer = vi.scan(free, {"start.Y": [0.3]}, **options | {"measure": vi.Regime(longest=80)})
    assert longer.period.values.tolist() == [77]


def test_chaotic_transients_differ_from_chaos():
    """After the last impact, the motion is linear and perturbations decay at the rate ξ."""
    lanes = [(0.69, 0.7, 0.001), (0.69, 0.5, 0.003), (0.7, 0.8, 0.0), (0.97, 0.8, 0.0)]
    data = _regimes_of(lanes, settle=22)
    assert np.asarray(data.period).tolist() == [-4, -4, -1, -1]
    meanings, values = (data.period.attrs[f"flag_{x}"] for x in ("meanings", "values"))
    named = dict(zip(meanings.split(), values, strict=True))
    assert named == {x.name: int(x) for x in vi.REGIMES}

    @jax.jit
    @jax.vmap
    def looked_at(zeta, k, xi):
        scene = vi.Scene.ideal(frequency_ratio=zeta, restitution=k, damping_ratio=xi)
        first = vi.lyapunov(scene, scene.start(), 256, settle=150, number=1).exponents[0]
        # Rounding determines when the chaos ends; then the transient decays by 0.9 % per cycle.
        return first, vi.simulate(scene, scene.start(), 64, settle=12_000)

    first, run = looked_at(*np.array(lanes).T)
    assert (first > 5e-3).all()
    assert (np.asarray(run.impacts.sum(axis=1)) == 0).tolist() == [True, True, False, False]
    for (zeta, _, xi), Y in zip(lanes[:2], run.last.Y, strict=False):
        steady = (1 / (1 - zeta**2 + 2j * xi * zeta)).real
        assert float(Y) == pytest.approx(steady, abs=1e-9)


@pytest.mark.slow
def test_windows_of_periods_near_a_grazing():
    """Beyond the grazing of a motion with multiplier 1/2 are windows of increasing period with
    one impact, and chaos between them (Chin, Ott, Nusse and Grebogi, Phys. Rev. E 50, 1994). The
    sections of a period differ by 1e-4 to 1e-6."""
    xi, ratio = 5.05, 0.2 * np.pi / np.log(2)
    amplitude = 1 / np.hypot(1 - ratio**2, 2 * xi * ratio)
    scene = vi.Scene.ideal(frequency_ratio=ratio, restitution=0.8, damping_ratio=xi)
    beyond = {7.1e-7: 8, 4.0e-6: 7, 1.5e-5: 6, 3.5e-5: vi.REGIMES.chaotic, 8.4e-5: 5}
    gaps = amplitude / (1 + np.array([*beyond])[::-1])
    data = vi.scan(scene, {"stops.0.gap": gaps}, measure=vi.Regime(lasting=0), settle=400)
    assert data["period"].values[::-1].tolist() == [*beyond.values()]
    periodic = data["period"] > 0
    np.testing.assert_array_equal(data["impacts"].values[periodic], 1)
    # A sweep agrees; before the grazing the motion has no impacts and period 1.
    values = [gaps[0], amplitude / (1 - 1e-5)]
    assert vi.sweep(scene, "stops.0.gap", values, settle=400).period.tolist() == [5, 1]


@pytest.mark.slow
def test_periods_of_artificial_sections():
    """Periods of artificial sections, whose tolerance depends on the best fit and on the method."""
    n, one = jnp.arange(256), jnp.ones(256, int)

    judged = jax.jit(partial(least_period, longest=64))

    def period(sections, impacts=one, wander=0.0, **options):
        return int(judged({"Y": sections}, impacts[None], wander=wander, **options))

    none, split = vi.REGIMES.unsettled, 1e-7 * (-1.0) ** n
    spiral = 3e-5 * 0.999**n * jnp.cos(2 * jnp.pi * n / 7)
    noise = 1e-7 * jax.random.normal(jax.random.key(0), (256,))
    assert period(0.0 * n) == 1 and period(split) == 2
    assert period(0.0 * n, impacts=n % 3) == 3
    assert period(spiral) == 1
    assert period(0.0 * n, impacts=jnp.where(n == 200, 2, 1)) == none
    assert period(1e-4 * jnp.cos(n)) == none and period(noise) == 1 and period(100 * noise) == none
    # Adaptive steps have errors of size `wander`, which hide a smaller split.
    assert period(100 * noise, wander=1e-5) == 1 and period(split, wander=1e-8) == 1
    assert period(noise, tolerance=1e-8) == none


class Small(vi.AbstractMachine):
    """A potential with one well, or with two, in a unit of length."""

    length: float
    steep: float = 1.0
    damping: float = 0.3
    cycle = 2 * np.pi / 0.77

    def field(self, s, x):
        y = x.x / self.length
        pull = 0.1 * jnp.cos(0.77 * s) + self.steep * (y - y**3) - (1 - self.steep) * y
        return vi.State(x=x.v, v=self.length * pull - self.damping * x.v)

    def start(self):
        return vi.State(x=0.3 * self.length, v=0.0 * self.length)


@pytest.mark.slow
def test_the_comparison_of_motions_scales_with_their_size(monkeypatch):
    """In any unit of length, motions that repeat after 77 cycles are unsettled. Two wells are two
    motions, found with few comparisons."""
    options: Any
    lengths, options = [1.0, 1e-6, 1e-9, 1e6], {"settle": 60, "progress": False}
    compared, shares, passes = [], [], MotionSections.passes
    counted = lambda *a, **options: compared.append(a) or passes(*a, **options)
    monkeypatch.setattr(MotionSections, "passes", counted)
    data = vi.scan(
        Small(1.0, 0.0, 0.0), {"length": lengths}, measure=vi.Regime(longest=8), **options
    )
    assert data.period.values.tolist() == [vi.REGIMES.unsettled] * 4
    for length in lengths:
        swept = vi.sweep(Small(length, 0.0, 0.0), "damping", [0.0], cycles=16, **options)
        assert swept.period.tolist() == [vi.REGIMES.unsettled]
        region = {"start.x": (-length, length)}
        found = vi.basins(Small(length), region, resolution=32, longest=2, **options)
        shares.append([attractor.starts for attractor in found.attractors])
        assert len(compared) < 16
        compared.clear()
    assert len(shares[0]) == 2 and sum(shares[0]) == 32 and shares == shares[:1] * 4


def test_quasi_periodic_motions_of_rings():
    """Their rotation number is a + 0.3 b/2π. With b < 0 the motion rests."""
    a = np.array([0.1234, 0.21, 0.3819])
    data = vi.scan(
        Ring(0.2, 0.1), {"a": a, "b": [-0.1, 0.1]}, start=at(0.3, 0.1), settle=500,
        measure=("regime", "rotation"), progress=False,
    )  # fmt: skip
    assert (data.period.values == [1, int(vi.REGIMES.quasiperiodic)]).all()
    turns = data.rotation.values[:, 1]
    np.testing.assert_allclose(turns, rotation_of(a, 0.1), atol=1e-9)
    assert (data.digits.values[:, 1] > 5).all()
    assert np.isnan(data.rotation.values[:, 0]).all() and (data.digits.values[:, 0] == 16).all()


def test_a_rotation_number_without_meaning_is_nan():
    """A component that is rounding does not count; a chaotic motion has no rotation number."""
    golden, random = (np.sqrt(5) - 1) / 2, np.random.default_rng(0)
    angles = 2 * np.pi * golden * np.arange(1024)
    rows = jnp.stack([np.cos(angles), np.sin(angles), 1e-17 * random.standard_normal(1024)], axis=1)
    assert agreement(rows) > 5 and abs(rotation_number(rows) - (1 - golden)) < 1e-9
    assert agreement(rows[:, 2:]) == 16 and np.isnan(rotation_number(rows[:, 2:]))
    assert np.isnan(rotation_number(1 + 1e-8 * rows, wander=1e-8))
    data = vi.scan(Ring(0.2, 1.4), {"a": [0.21]}, measure="rotation", start=at(0.3, 0.1))
    assert data.digits.values[0] < 3.5 and np.isnan(data.rotation.values[0])


def test_rotation_numbers_of_other_curves_are_nan():
    """On two curves the angle around their common mean turns by 1/2 in each cycle; on a crescent
    whose mean is outside it does not turn. A motion that repeats keeps its number."""
    checked, turns = jax.jit(checked_rotation_number), 2 * np.pi * np.arange(1024)
    circle = lambda a: jnp.stack([jnp.cos(a), jnp.sin(a)], axis=1)
    one, sides = circle(0.21 * turns), jnp.asarray([[1.0, 0.0], [-1.0, 0.0]] * 512)
    assert checked(one) == pytest.approx(0.21, abs=1e-9)
    for radius in (0.5, 1e-2, 1e-6):
        assert rotation_number(radius * one + sides) == pytest.approx(0.5, abs=1e-4)
        assert np.isnan(checked(radius * one + sides))
    # Two curves around a common mean: in two cycles the motion turns by 0.42.
    assert checked(one + 0.1 * sides) == pytest.approx(0.21, abs=1e-9)
    bent = (1 + 0.1 * one[:, :1]) * circle(2 * one[:, 1])
    assert rotation_number(bent) < 0.02 and np.isnan(checked(bent))
    for p, q in ((1, 2), (1, 3), (2, 5), (3, 8)):
        assert checked(circle(p / q * turns)) == pytest.approx(p / q, abs=1e-12)
    options: Any = {"start": at(2.3, 0.1), "settle": 500, "progress": False}
    data = vi.scan(Alternating(0.21, 0.1), {"a": [0.21]}, measure="rotation", **options)
    assert np.isnan(data.rotation.values).all() and (data.digits.values > 5).all()


@pytest.mark.slow
def test_rotation_numbers_of_a_sweep():
    a = np.array([0.1234, 0.21, 0.3819])
    options: Any = {"start": at(0.3, 0.1), "settle": 500, "progress": False}
    swept = vi.sweep(Ring(0.2, 0.1), "a", a, measure=vi.Rotation(512), **options)
    table = swept.to_xarray()
    np.testing.assert_allclose(table.rotation.values, rotation_of(a, 0.1), atol=1e-8)
    assert (table.digits.values > 5).all()
    for measure, words in (("exponent", "Exponent needs more"), ("sections", "arrays are '0'")):
        with pytest.raises(ValueError, match=words):
            vi.sweep(Ring(0.2, 0.1), "a", a, measure=measure, **options)


class Undriven(vi.AbstractMachine):
    """The map of `Ring`, at the events that end the cycles of an autonomous machine."""

    a: float
    b: float = 0.1
    cycle = 1.0

    @property
    def events(self):
        def kick(machine, s, x):
            u, v = Ring(machine.a, machine.b).kick(x.x, x.y)
            return vi.State(x=u, y=v, t=0.0)

        return (vi.Reset(lambda machine, s, x: x.t - 1, kick, ends_cycle=True),)

    def field(self, s, x):
        return vi.State(x=0.0 * x.x, y=0.0 * x.y, t=1.0)


@pytest.mark.slow
def test_motions_of_an_autonomous_machine():
    """Exponents across the motion are those of the map between its sections."""
    a, start = np.array([0.21, 0.3819]), vi.State(x=0.3, y=0.1, t=0.0)
    data = vi.scan(
        Undriven(0.2), {"a": a, "b": [-0.1, 0.1, 1.4]}, start=start, settle=500,
        measure=("regime", "rotation"), progress=False,
    )  # fmt: skip
    expected = [1, int(vi.REGIMES.quasiperiodic), int(vi.REGIMES.chaotic)]
    driven = vi.scan(
        Ring(0.2, 0.1), {"a": a, "b": [-0.1, 0.1, 1.4]}, start=at(0.3, 0.1), settle=500,
        measure="regime", progress=False,
    )  # fmt: skip
    assert (data.period.values == expected).all() and (driven.period.values == expected).all()
    np.testing.assert_allclose(data.rotation.values[:, 1], rotation_of(a, 0.1), atol=1e-9)


@pytest.mark.slow
def test_a_motion_that_slowly_locks_is_not_quasi_periodic():
    """In the window 1:3 perturbations change by a share of 3 locking b³ᐟ² in a cycle, at most."""
    options: Any = {"start": at(0.3, 0.1), "settle": 500, "progress": False}
    middle = 1 / 3 - rotation_of(0.0, 0.1)
    data = vi.scan(
        Ring(middle, 0.1), {"locking": [1e-3, 0.0]}, measure=("regime", "rotation"), **options
    )
    assert (data.period.values == [int(vi.REGIMES.unsettled), 3]).all()
    assert data.digits.values[0] < 3.5 and np.isnan(data.rotation.values[0])  # not yet locked
    assert data.rotation.values[1] == pytest.approx(1 / 3, abs=1e-12)
    slow = vi.lyapunov(
        Ring(middle, 0.1, locking=1e-3), at(0.3, 0.1), 2048, settle=500, number=1, progress=False
    )
    assert 0.1 < abs(float(slow.per_cycle[0])) * 2048 < 2048 * 3e-3 * 0.1**1.5
