"""Integrity of the motions of machines, over a parameter and beside published shares."""

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
import vi_jax as vi

matplotlib.use("Agg")

SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.8, gap=2.0, damping_ratio=0.05)
ZETA = "drive.frequency_ratio"
REGION = {"start.Y": (-6.0, 2.0), "start.V": (-6.0, 9.0)}
QUICK = {"resolution": (14, 12), "settle": 400, "longest": 8, "progress": False}


@pytest.fixture(scope="module")
def profile():
    return vi.integrity_profile(SCENE, ZETA, [1.5, 1.3, 1.4, 0.9], REGION, **QUICK)


@pytest.mark.slow
def test_motions_are_followed_along_the_values(profile):
    assert profile.values.tolist() == [0.9, 1.3, 1.4, 1.5]
    names = [profile.name_of(i) for i in range(3)]
    assert names == ["2π, 1 impact", "4π, 1 impact", "2π, 0 impacts"]
    hit, long, free = profile.share
    assert hit[0] == 0 and (np.diff(hit[1:]) < 0).all()  # ever fewer starts go to the impacts
    assert long.tolist() == [1.0, 0.0, 0.0, 0.0]
    assert free[0] == 0 and (np.diff(free[1:]) > 0).all()
    np.testing.assert_allclose(profile.share.sum(axis=0), 1.0)
    assert profile.label.tolist()[1] == [0, -1, -1, -1]
    assert np.isnan(profile.local[1, 1:]).all() and np.isfinite(profile.local[0, 1:]).all()
    for i, found in enumerate(profile.basins):
        for reach in found.integrity():
            motion = int(np.flatnonzero(profile.label[:, i] == reach.label)[0])
            assert profile.local[motion, i] == reach.local
            assert profile.factor[motion, i] == reach.factor
            assert profile.factor_at_edge[motion, i] == reach.factor_at_edge


def test_an_edge_at_a_stop_ends_no_ball(profile):
    """The region ends at the stop, Y = 2, which the motion of one impact is near."""
    label = profile.basins[0].data["label"]
    assert label.attrs["at_stop"] == ["start.Y high"]
    there = profile.basins[2].attractors[0]
    assert there.impacts == 1 and 2.0 - there.sections["Y"][0] < profile.local[0, 2]
    assert not profile.local_at_edge[0, 2]


def test_other_numbers_compile_nothing(profile):
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, *_, **__: compiled.append(name) if "backend_compile" in name else None
    )
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.75, gap=2.0, damping_ratio=0.04)
    region = {"start.Y": (-5.0, 2.0), "start.V": (-6.0, 5.0)}
    other = vi.integrity_profile(scene, ZETA, [0.92, 1.32, 1.42, 1.48], region, **QUICK)
    assert not compiled and other.share.shape[1] == 4


def test_a_profile_as_data_words_and_picture(profile):
    data = profile.to_xarray()
    assert data.share.dims == ("motion", ZETA) and data.local.shape == (3, 4)
    np.testing.assert_array_equal(data.factor.sel({ZETA: 1.4}), profile.factor[:, 2])
    assert len(profile.to_xarray(along="motion").to_dataframe()) == 3
    text = str(profile)
    assert text.startswith(f"Integrity over {ZETA}, 4 values from 0.9 to 1.5: 3 motions")
    assert "4π, 1 impact, 0.9 to 0.9: at most 100.0 % at 0.9" in text
    for y, word in (("share", "part of the starts"), ("local", "around"), ("factor", "ball")):
        ax = vi.plot_integrity(profile, y=y)
        lines = [x for x in ax.get_lines() if len(x.get_xdata()) == 4 and x.get_ls() == "-"]
        drawn = np.array([x.get_ydata() for x in lines])
        np.testing.assert_allclose(drawn, getattr(profile, y) * (100 if y == "share" else 1))
        assert word in ax.get_ylabel() and "ζ" in ax.get_xlabel()
        assert "2π, 1 impact" in [x.get_text() for x in ax.get_legend().get_texts()]
    with pytest.raises(ValueError, match="`y` must be one of"):
        vi.plot_integrity(profile, y="area")


def test_refused_before_any_work():
    def ask(values=(0.9, 1.0), region=REGION, **options):
        return vi.integrity_profile(SCENE, ZETA, values, region, **{**QUICK, **options})

    with pytest.raises(ValueError, match="one row of finite real numbers"):
        ask([np.nan])
    with pytest.raises(ValueError, match="`scales` must name"):
        ask(scales={"start.W": 1.0})
    with pytest.raises(ValueError, match="`resolution` must be at least 2"):
        ask(resolution=1)
    with pytest.raises(TypeError, match="`samples` is not to be given"):
        ask(samples=100)
    with pytest.raises(ValueError, match="frequency"):
        vi.integrity_profile(SCENE, "drive.frequency", [0.9], REGION)


@pytest.mark.slow
def test_all_of_the_ball_settles_on_the_motion():
    """Simulated on circles around the motion: a little inside of the ball all starts come back to
    it, a little outside some do not."""
    options = {**QUICK, "resolution": (96, 144)}
    found = vi.integrity_profile(SCENE, ZETA, [1.4], REGION, **options)
    (one,) = found.basins
    for motion, reach in zip(one.attractors, one.integrity(), strict=True):
        assert not reach.local_at_edge
        angle = np.linspace(0.0, 2 * np.pi, 400)
        share = []
        for radius in (reach.local - reach.resolution, reach.local + 2 * reach.resolution):
            Y = float(motion.sections["Y"][0]) + radius * np.cos(angle)
            V = float(motion.sections["V"][0]) + radius * np.sin(angle)
            starts = {"start.Y": Y[Y < 2.0], "start.V": V[Y < 2.0]}
            scene = vi.Scene.ideal(
                frequency_ratio=1.4, restitution=0.8, gap=2.0, damping_ratio=0.05
            )
            ends = vi.scan(scene, starts, measure="regime", settle=400, paired=True, progress=False)
            share.append(float(np.mean(np.round(ends["impacts"]) == round(motion.impacts))))
        assert share[0] == 1.0 and share[1] < 1.0


def duffing(starts, cycles=120, steps=48):
    """Where starts of x'' + .15x' - x + x³ = .2 cos t end, by the classical Runge-Kutta method."""
    field = lambda t, s: np.array([s[1], 0.2 * np.cos(t) - 0.15 * s[1] + s[0] - s[0] ** 3])
    h = 2 * np.pi / steps
    for i in range(cycles * steps):
        t = (i % steps) * h
        a = field(t, starts)
        b = field(t + h / 2, starts + h / 2 * a)
        c = field(t + h / 2, starts + h / 2 * b)
        d = field(t + h, starts + h * c)
        starts = starts + h / 6 * (a + 2 * b + 2 * c + d)
    return starts


@pytest.mark.exhaustive
def test_shares_of_a_bistable_oscillator_without_stops():
    """Attractors.jl has 0.489 and 0.511 of 1,000 random starts (left and right well)."""
    machine = vi.machines.Duffing(amplitude=0.2, damping=0.15, stiffness=-1.0, cubic=1.0, gap=100.0)
    region = {"start.Y": (-2.2, 2.2), "start.V": (-2.2, 2.2)}
    found = vi.basins(machine, region, resolution=96, settle=250, progress=False)
    assert len(found.attractors) == 2 and not any(found.irregular.values())
    share = {bool(a.sections["Y"][0] > 0): a for a in found.attractors}
    for right, published in ((False, 0.489), (True, 0.511)):
        spread = np.hypot(share[right].error, np.sqrt(0.25 / 1000))
        assert abs(share[right].fraction - published) < 2 * spread
    # The same by a method written here, of other starts: and where the two wells are.
    ends = duffing(np.random.default_rng(5).uniform(-2.2, 2.2, (2, 2000)))
    right = ends[0] > 0
    spread = np.hypot(share[True].error, np.sqrt(0.25 / 2000))
    assert abs(share[True].fraction - right.mean()) < 3 * spread
    well = np.median(ends[:, right], axis=1)
    expected = [share[True].sections[name][0] for name in ("Y", "V")]
    np.testing.assert_allclose(well, expected, atol=1e-4)
    # Its boundary is fractal: it says so itself.
    assert found.uncertainty().interval[1] < 0.5


class Pendulum(vi.AbstractMachine):
    """θ'' + 0.1 θ' + sin θ = f cos t, its angle counted from -π to π as each cycle begins."""

    force: float
    stops: tuple = ()
    cycle: float = 2 * np.pi

    def field(self, s, state):
        """Angle and speed."""
        push = self.force * jnp.cos(s) - 0.1 * state.V - jnp.sin(state.Y)
        return vi.OscillatorState(state.V, push)

    def start(self, *, Y=0.0, V=0.0):
        """At rest below."""
        return vi.OscillatorState(jnp.asarray(Y, float), jnp.asarray(V, float))

    def renewed(self, state):
        """No turns are counted."""
        return vi.OscillatorState(jnp.mod(state.Y + jnp.pi, 2 * jnp.pi) - jnp.pi, state.V)


def turned(Y, V, force, cycles=160, steps=48):
    """The speeds of forced pendulums after so many cycles, by the classical Runge-Kutta method."""
    h = 2 * np.pi / steps
    push = force * np.cos(np.arange(2 * steps + 1) * h / 2)
    rate = lambda k, y, v: push[k] - 0.1 * v - np.sin(y)
    for _ in range(cycles):
        for k in range(0, 2 * steps, 2):
            a = rate(k, Y, V)
            b = rate(k + 1, Y + h / 2 * V, V + h / 2 * a)
            c = rate(k + 1, Y + h / 2 * (V + h / 2 * a), V + h / 2 * b)
            d = rate(k + 2, Y + h * (V + h / 2 * b), V + h * c)
            Y, V = Y + h * V + h**2 / 6 * (a + b + c), V + h / 6 * (a + 2 * b + 2 * c + d)
    return V


@pytest.mark.exhaustive
def test_the_exponent_of_a_pendulum_goes_on_below_the_grid():
    """Two motions that turn, f = 2: what the grid says over a decade of distances, pairs of random
    starts from 1e-2 to 1e-7 apart say too (the method of the paper of 1983), by the classical
    Runge-Kutta method. No published interval for it was found."""
    machine = Pendulum(2.0)
    region = {"start.Y": (-0.5, 0.5), "start.V": (0.5, 1.5)}
    found = vi.basins(machine, region, resolution=144, settle=120, longest=8, progress=False)
    speeds = [float(a.sections["V"][0]) for a in found.attractors]
    assert len(speeds) == 2 and min(speeds) < 0 < max(speeds)
    exponent, (low, high) = found.uncertainty().exponents[0], found.uncertainty().intervals[0]
    assert high - low < 0.04

    many, apart = 1500, 10.0 ** -np.arange(2, 8)
    rng = np.random.default_rng(3)
    Y, V = rng.uniform(-0.5, 0.5, many), rng.uniform(0.5, 1.5, many)
    shifted = [Y, *(Y + side * x for x in apart for side in (1, -1))]
    right = turned(np.stack(shifted), np.tile(V, (len(shifted), 1)), 2.0) > 0
    differ = (right[1::2] != right[0]) | (right[2::2] != right[0])
    part = differ.mean(axis=1)
    slope = np.polyfit(np.log(apart), np.log(part), 1)[0]
    # By binomial chance of the ends of the row, which the slope over five decades rests on.
    error = np.sqrt(np.sum((1 / part[[0, -1]] - 1) / many)) / np.log(1e5)
    assert abs(slope - exponent) < 2 * np.hypot(error, (high - low) / 4)
