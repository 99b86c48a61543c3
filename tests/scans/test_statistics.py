"""Means with errors, densities and escapes under noise, compared with theory."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
import xarray as xr
from scipy.linalg import eigvals, expm, solve_discrete_lyapunov
from scipy.stats import norm

from free_oscillator import Free

CYCLE, SIGMA, IMPULSES = 2 * np.pi, 0.5, 16
STEP = CYCLE / IMPULSES
START = vi.OscillatorState(jnp.array(0.0), jnp.array(0.0))
NOISE = vi.WhiteNoise({"V": SIGMA}, impulses=IMPULSES)


# Between impulses the state follows a linear map, so that its covariance is known exactly.
FLOW = expm(np.array([[0.0, 1.0], [-1.0, -0.2]]) * STEP)
JUMP = np.diag([0.0, SIGMA**2 * STEP])
COVARIANCE = solve_discrete_lyapunov(FLOW, JUMP)

EDGES = np.linspace(-2.5, 2.5, 11)
LANES = 256


@pytest.fixture(scope="module")
def shaken():
    measure = (
        vi.Statistics("Y", samples=4), vi.Statistics("V", samples=4),
        vi.Density({"Y": EDGES}, samples=4),
    )  # fmt: skip
    return vi.scan(
        Free(), {"noise.path": np.arange(LANES)}, measure=measure, start=START, settle=20,
        cycles=320, noise=NOISE, key=jax.random.key(1), progress=False,
    )  # fmt: skip


def test_the_variances_of_a_linear_oscillator(shaken):
    assert abs(COVARIANCE[0, 0] - 0.625) < 2e-5  # 0.625 is the limit of continuous noise
    for i, name in enumerate("YV"):
        square = shaken[f"{name}_spread"] ** 2 + shaken[f"{name}_mean"] ** 2
        error = float(square.std(ddof=1)) / LANES**0.5
        assert error < 0.01
        assert abs(float(square.mean()) - COVARIANCE[i, i]) < 3 * error


def test_batch_means_agree_with_the_scatter_of_lanes(shaken):
    """The scatter of 256 lanes has an error of 4.4 % (9 % of the variance). Squared errors from 16
    parts scatter by 37 %, and their mean by 2.3 %. The tolerance 0.2 is three times both, plus the
    correlation between parts of 20 cycles."""
    for name in ("Y", "V"):
        for what, error in (("mean", "error"), ("spread", "spread_error")):
            found = float((shaken[f"{name}_{error}"] ** 2).mean() ** 0.5)
            assert abs(found / float(shaken[f"{name}_{what}"].std(ddof=1)) - 1) < 0.2


def test_the_error_of_a_mean_comes_from_the_means_of_parts():
    def given(machine, run):
        return jnp.array([9.0, 0.0, 2.0, 4.0, 10.0])

    found = vi.Statistics(given, batches=2)(None, None)
    assert float(found["given_mean"]) == 5.0
    # Parts have equal lengths, so the first number is left out; their means are 1 and 7.
    assert float(found["given_error"]) == pytest.approx(3.0, rel=1e-14)


def test_the_density_is_gaussian(shaken):
    shares = np.diff(norm.cdf(EDGES / COVARIANCE[0, 0] ** 0.5))
    density = shaken.density.mean("noise.path").values
    error = shaken.density.std("noise.path", ddof=1).values / LANES**0.5
    assert np.all(np.abs(density - shares / 0.5) < 4 * error)
    assert np.max(error) < 0.01
    whole = (shaken.density.sum("Y_bin") * 0.5 + shaken.outside).values
    np.testing.assert_allclose(whole, 1.0, rtol=1e-12)
    assert shaken.density.attrs["Y_edges"] == EDGES.tolist()


def test_a_density_in_two_variables_agrees_with_numpy():
    names = "YV"
    edges = {"V": np.linspace(-1.0, 1.5, 6), "Y": np.linspace(-1.0, 1.0, 4)}
    edges = {name: edges[name] for name in names}
    given = {"settle": 3, "cycles": 64, "noise": NOISE, "key": jax.random.key(2)}
    data = vi.scan(
        Free(), {"noise.path": [0, 1]}, measure=(vi.Density(edges), vi.Sections(64)),
        start=START, progress=False, **given,
    )  # fmt: skip
    for lane in (0, 1):
        here = data.sel({"noise.path": lane})
        first, second = names
        counts, *_ = np.histogram2d(here[first], here[second], list(edges.values()))
        np.testing.assert_allclose(here.density, counts / 64 / (0.5 * 2 / 3), atol=1e-12)
        assert abs(float(here.outside) - (1 - counts.sum() / 64)) < 1e-12
    assert data.density.dims == ("noise.path", *(f"{name}_bin" for name in names))


def test_a_body_on_the_last_edge_is_in_the_last_bin():
    """NumPy counts alike. Once a body at rest on a stop was in no bin."""
    pressed = vi.Scene.ideal(frequency_ratio=1.0, restitution=0.0, gap=-2.0)
    start = pressed.start(Y=-2.0)
    density = vi.Density({"Y": np.linspace(-3.0, -2.0, 3)})
    data = vi.scan(pressed, {"start.Y": [-2.0]}, measure=density, start=start, progress=False)
    np.testing.assert_allclose(data.density[0], [0.0, 2.0])
    assert float(data.outside[0]) == 0


class Reflected(Free):
    """The free oscillator with an elastic stop at 0."""

    @property
    def contacts(self):
        return (vi.RigidStop(0.0, 1.0, "left"),)


@pytest.mark.slow
def test_impacts_on_an_elastic_stop_agree_with_rices_formula():
    """Compare with Rice's formula, with the covariance at each time between two impulses. It is
    exact for 4 impulses per cycle."""
    step = CYCLE / 4
    turn = expm(np.array([[0.0, 1.0], [-1.0, -0.2]]) * step)
    begin = solve_discrete_lyapunov(turn, np.diag([0.0, SIGMA**2 * step]))
    places, weights = np.polynomial.legendre.leggauss(20)
    rate = 0.0
    for place, weight in zip(places, weights, strict=True):
        flow = expm(np.array([[0.0, 1.0], [-1.0, -0.2]]) * step * 0.5 * (place + 1))
        here = flow @ begin @ flow.T
        rate += 0.5 * weight * np.linalg.det(here) ** 0.5 / here[0, 0] / np.pi
    data = vi.scan(
        Reflected(), {"noise.path": np.arange(512)}, measure=vi.Statistics("impacts"), start=START,
        settle=20, cycles=400, noise=vi.WhiteNoise({"V": SIGMA}, impulses=4), progress=False,
        key=jax.random.key(9),
    )  # fmt: skip
    mean = float(data.impacts_mean.mean()) / CYCLE
    error = float(data.impacts_mean.std(ddof=1)) / 512**0.5 / CYCLE
    assert error < 1e-3 * rate
    assert abs(mean - rate) < 3 * error
    assert abs(rate - 1 / np.pi) > 3 * error  # continuous noise would differ


class Relaxing(vi.AbstractMachine):
    """x' = -x + σ dW with cycle 0.5."""

    cycle = 0.5

    def field(self, s, x):
        return {"x": -x["x"]}


def test_the_escape_rate_agrees_with_the_map_of_densities():
    """The share that survives an impulse is the largest eigenvalue of the map of densities below
    the threshold (by Gauss-Legendre quadrature)."""
    sigma, high = 1.0, 1.5
    nodes, weights = np.polynomial.legendre.leggauss(80)
    x, w = high + 4 * (nodes - 1), 4 * weights
    jump = sigma * 0.5**0.5
    left = np.max(np.abs(eigvals(norm.pdf((x[:, None] - np.exp(-0.5) * x) / jump) / jump * w)))
    data = vi.scan(
        Relaxing(), {"noise.path": np.arange(2048)}, measure=vi.Escape("x", high=high, samples=1),
        start={"x": jnp.array(0.0)}, settle=0, cycles=60, key=jax.random.key(5), progress=False,
        noise=vi.WhiteNoise({"x": sigma}, impulses=1),
    )  # fmt: skip
    found = vi.escape_rate(data, after=8, confidence=0.99)
    assert found.rate_low < -np.log(left) < found.rate_high
    assert found.rate_high / found.rate_low < 1.2
    assert int(found.escapes) + int(found.censored) < 2048 == data.escaped.size
    assert int(found.censored) == int((data.escaped == 0).sum()) > 20
    # The mean escape time underestimates, since it stops at censored paths.
    assert 1 / float(data.escape_cycle.mean()) > float(found.rate_high)


@pytest.mark.parametrize(
    "of, samples, settle", [("Y", 4, 2), pytest.param("y_max", 0, 2, marks=pytest.mark.slow)]
)
def test_a_lane_ends_at_its_escape(of, samples, settle):
    """Results agree with those of a scan whose second measure needs all cycles."""
    given = {"settle": settle, "cycles": 32, "noise": NOISE, "key": jax.random.key(2)}
    alone = vi.Escape(of, high=2.0, samples=samples)
    other = vi.Density({"V": EDGES}, samples=samples)
    short, long = (
        vi.scan(Free(), {"noise.path": np.arange(64)}, start=START, measure=m, **given)
        for m in (alone, (alone, other))
    )
    assert 5 < int(short.escaped.sum()) < 64
    for name in short.data_vars:
        np.testing.assert_array_equal(short[name], long[name])


class Bursting(vi.AbstractMachine):
    """x' = x², which diverges at time 1/x(0)."""

    cycle: float = 0.25

    def field(self, s, x):
        return {"x": x["x"] ** 2}


def test_failures_after_an_escape_do_not_count():
    found = vi.scan(
        Bursting(), {"start.x": [0.5, 0.05]}, measure=vi.Escape("x", high=1.0 + 1e-6),
        start={"x": jnp.array(0.5)}, settle=0, cycles=12, progress=False,
    )  # fmt: skip
    assert found.escape_cycle.values.tolist() == [5.0, 12.0]
    assert found.escaped.values.tolist() == [1, 0] and not found.result.values.any()


def test_escapes_and_censored_paths_are_counted():
    data = xr.Dataset(
        {
            "escape_cycle": (("a", "path"), [[2.0, 10.0, 10.0, 0.0], [10.0, 10.0, np.nan, 10.0]]),
            "escaped": (("a", "path"), [[1, 0, 0, 1], [0, 0, 0, 0]]),
        }
    )
    data.escape_cycle.attrs["step"] = 1.0
    found = vi.escape_rate(data, "path")
    assert found.escapes.values.tolist() == [1, 0]
    assert found.censored.values.tolist() == [2, 3]
    assert found.cycles.values.tolist() == [22.0, 30.0]
    np.testing.assert_allclose(found.rate, [-np.log(1 - 1 / 22), 0.0])
    # Garwood's interval of 1 and of 0 events: 0.0253 to 5.572, and 0 to 3.689.
    np.testing.assert_allclose(found.rate_low, [-np.log(1 - 0.025318 / 22), 0.0], rtol=1e-4)
    high = -np.log(1 - np.array([5.571643 / 22, 3.688879 / 30]))
    np.testing.assert_allclose(found.rate_high, high, rtol=1e-6)
    late = vi.escape_rate(data, after=2.0)
    assert (int(late.escapes), int(late.censored), float(late.cycles)) == (0, 5, 40.0)


@pytest.mark.slow
def test_extremes_detect_escapes_between_sections():
    given = {"settle": 3, "cycles": 32, "noise": NOISE, "key": jax.random.key(2), "start": START}
    late, soon = (
        vi.scan(Free(), {"noise.path": np.arange(64)}, measure=m, progress=False, **given)
        for m in (vi.Escape("Y", high=0.8, samples=1), vi.Escape("y_max", high=0.8))
    )
    both = (late.escaped & soon.escaped) == 1
    assert both.sum() > 30
    # The maximal position of a cycle is known at its end, first after one cycle.
    assert np.all(soon.escape_cycle <= np.maximum(late.escape_cycle, 1.0))
    assert np.mean(soon.escape_cycle < late.escape_cycle) > 0.5


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: vi.Statistics("V", batches=1), "Argument `batches`"),
        (lambda: vi.Density({"Y": [0.0, 0.0]}), "in rising order"),
        (lambda: vi.Density({"Y": [0, 1], "V": [0, 1], "W": [0, 1]}), "one name or two"),
        (lambda: vi.Escape("Y"), "one of them finite"),
        (lambda: vi.Escape("Y", low=1.0, high=0.0), "ends of an interval"),
        (lambda: vi.escape_rate(xr.Dataset()), "measure `Escape`"),
        (lambda: scan_of(vi.Statistics("W")), "must be one of Y, V, impacts"),
        (lambda: scan_of(vi.Statistics("impacts", samples=4)), "must be one of Y, V, but"),
        (lambda: scan_of(vi.Statistics("V", 4), cycles=3), "at least 4 for the measure Statistics"),
        (
            lambda: scan_of((vi.Statistics("V", samples=4), vi.Escape("Y", high=1.0, samples=2))),
            r"one number of samples, but asks for \[2, 4\]",
        ),
    ],
)
def test_invalid_arguments_raise(make, message):
    with pytest.raises((TypeError, ValueError), match=message):
        make()


def scan_of(measure, cycles=32):
    return vi.scan(Free(), {"start.Y": [0.0]}, measure=measure, start=START, cycles=cycles)
