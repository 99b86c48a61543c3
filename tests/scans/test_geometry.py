"""The geometry of basins, for labels with known results."""

import itertools

import numpy as np
import pytest
import vi_jax as vi
import xarray as xr
from vi_jax.scans._geometry import Cells, ball_around, entropy_of, largest_ball, uncertainty_of

ONES, CLOSED = np.ones(2), np.ones((2, 2), bool)


def square(size, low=-1.0, high=1.0):
    """Return the centres of cells along an axis, and the grid of them."""
    x = low + (high - low) * (np.arange(size) + 0.5) / size
    return x, *np.meshgrid(x, x, indexing="ij")


def test_balls_in_a_half_plane_are_exact():
    """The basin is x < 0.1 in the square ±1; radii are distances to the line or the edges."""
    x, across, _ = square(200)
    own = across < 0.1
    cells = Cells([x, x], ONES, CLOSED)
    found = ball_around(np.array([-0.4, 0.0]), ~own, cells)
    assert found.radius == pytest.approx(0.5, abs=1e-12) and not found.at_edge
    found = ball_around(np.array([-0.8, 0.3]), ~own, cells)
    assert found.radius == pytest.approx(0.2, abs=1e-12) and found.at_edge
    largest = largest_ball(own, ~own, cells)
    assert largest.radius == pytest.approx(0.55, abs=1e-12) and largest.at_edge
    assert largest.centre[0] == pytest.approx(-0.45, abs=1e-12)
    # Twice the distance along y: upper and lower edges no longer limit the ball.
    wide = cells._replace(scales=np.array([1.0, 0.5]))
    assert largest_ball(own, ~own, wide).radius == pytest.approx(0.55, abs=1e-12)
    narrow = cells._replace(scales=np.array([1.0, 4.0]))
    assert largest_ball(own, ~own, narrow).radius == pytest.approx(0.25, abs=1e-12)
    # The left edge is a stop, which does not limit a ball.
    stop = cells._replace(ends=np.array([[False, True], [True, True]]))
    assert largest_ball(own, ~own, stop).radius == pytest.approx(1.0, abs=1e-12)
    assert ball_around(np.array([-0.8, 0.3]), ~own, stop).radius == pytest.approx(0.7, abs=1e-12)
    assert np.isnan(ball_around(np.array([-1.2, 0.3]), ~own, stop).radius)


@pytest.mark.parametrize("turns", [False, True])
def test_the_largest_ball_agrees_with_brute_force(turns):
    """Compare random labels, with missing cells, over all candidate centres. A periodic axis may
    begin at any angle."""
    rng = np.random.default_rng(0)
    for _ in range(5):
        label = (rng.random((9, 12)) < 0.1).astype(int)
        is_start = rng.random(label.shape) < 0.9
        rows = [np.linspace(0.1, 1.7, 9), np.linspace(-2.0, 0.2, 12)]
        ends = rng.random((2, 2)) < 0.7
        if turns:
            rows[0], ends[0] = 0.7 + 2 * np.pi * np.arange(9) / 9, False
        cells = Cells(rows, np.array([0.7, 1.3]), ends, np.array([turns, False]))
        own, foreign = is_start & (label == 0), is_start & (label == 1)
        best = 0.0
        for i, j in np.argwhere(own):
            for step in itertools.product((-0.5, 0.0, 0.5), repeat=2):
                point = np.array([rows[0][i], rows[1][j]]) + cells.widths * step
                point = np.clip(point, *cells.edges.T)
                best = max(best, ball_around(point, foreign, cells).radius)
        assert largest_ball(own, foreign, cells).radius == pytest.approx(best, rel=1e-9)
        shifts = range(9 if turns else 0)
        rolled = [(np.roll(x, n, axis=0) for x in (own, foreign)) for n in shifts]
        assert all(largest_ball(*x, cells).radius == pytest.approx(best) for x in rolled)


def test_entropy_of_half_planes_and_stripes():
    _, across, _ = square(100)
    aligned = entropy_of((across > 0.0).astype(int), box=5)
    assert aligned.total == 0.0 and np.isnan(aligned.boundary) and aligned.boundary_boxes == 0
    # The line cuts one column of boxes, with two of five cells on one side.
    cut = entropy_of((across > 0.04).astype(int), box=5)
    one = -(0.4 * np.log(0.4) + 0.6 * np.log(0.6))
    assert cut.boundary == pytest.approx(one) and cut.total == pytest.approx(one / 20)
    assert (cut.boxes, cut.boundary_boxes) == (400, 20)
    # Three alternating outcomes; each row of a box has all of them twice.
    turns = np.broadcast_to(np.arange(60) % 3, (60, 60))
    found = entropy_of(turns, box=6)
    assert found.total == pytest.approx(np.log(3)) and found.boundary == pytest.approx(np.log(3))
    # Missing cells do not count as an outcome.
    is_start = turns != 2
    assert entropy_of(turns, box=6, is_start=is_start).total == pytest.approx(np.log(2))


def test_a_smooth_boundary_has_the_exponent_one():
    _, across, up = square(256)
    for label in (across > 0.1, across**2 + up**2 < 0.6**2, across > 0.3 * up + 0.1):
        found = uncertainty_of(label.astype(int))
        assert found.exponent == pytest.approx(1.0, abs=0.01)
    assert np.isnan(uncertainty_of((across > 0.1).astype(int)).exponents[1])
    nothing = uncertainty_of(np.zeros((64, 64), int))
    assert np.isnan(nothing.exponent)


@pytest.mark.parametrize(("grows", "falls"), [(3, 1.5), (3, 2.0)])
def test_the_exponent_of_a_boundary_with_known_dimension(grows, falls):
    """x -> grows·x mod 1, y -> falls·y + cos 2πx (McDonald, Grebogi, Ott and Yorke, Physica D 17,
    125 (1985)): y goes to ±∞. The boundary is a Weierstrass curve of dimension
    2 - ln(falls) / ln(grows). It is the graph of a function, so the exponent along y is 1."""
    size = 1024
    x = (np.arange(size) + 0.5) / size
    powers = np.arange(25)
    waves = np.cos(2 * np.pi * grows**powers * x[:, None]) * falls ** -(powers + 1.0)
    label = (4 * x - 2 > -waves.sum(axis=1)[:, None]).astype(int)
    found = uncertainty_of(label)
    exact = np.log(falls) / np.log(grows)
    assert abs(found.exponent - exact) < 0.03
    assert found.exponents[1] == pytest.approx(1.0, abs=0.01)


def disc_and_rest(size=40, *, beyond=0.8):
    """Starts in ±1; those within 0.6 of 0 settle on a motion of two cycles. Starts with
    V > `beyond` fail, as beyond a stop."""
    x, Y, V = square(size)
    label = np.where(Y**2 + V**2 < 0.6**2, 0, 1)
    result = np.where(V > beyond, 1, 0)
    coords = {"start.Y": x, "start.V": x}
    of, names = {"label": label, "result": result}, tuple(coords)
    data = xr.Dataset({name: (names, x) for name, x in of.items()}, coords=coords)
    sections = {"Y": np.array([0.1, 0.0]), "V": np.array([0.0, -0.3])}
    inside = vi.Attractor(0, 2, 1.0, sections, 1, 0.3, 0.01)
    outside = vi.Attractor(1, 1, 1.0, {"Y": np.array([5.0]), "V": np.array([0.0])}, 1, 0.7, 0.01)
    return vi.Basins(data, [inside, outside], {}, vi.Scene.ideal(frequency_ratio=0.9))


def test_integrity_of_motions():
    found = disc_and_rest(200)
    inside, outside = found.integrity()
    assert str(inside).startswith("Integrity(\n  label=0,\n  local=") and "array" not in str(inside)
    assert inside.resolution == pytest.approx(np.sqrt(2) / 200)
    np.testing.assert_allclose(inside.sections, [0.5, 0.3], atol=inside.resolution)
    assert inside.local == inside.sections.min() and not inside.local_at_edge
    assert inside.factor == pytest.approx(0.6, abs=inside.resolution)
    assert np.isnan(outside.local) and outside.factor_at_edge
    # Twice the distance along V: the minimum of Y² + 4 (V + 0.3)² on the circle.
    halved = found.integrity(scales={"start.V": 0.5})[0]
    np.testing.assert_allclose(halved.sections[1], np.sqrt(0.24), atol=halved.resolution)


def test_invalid_requests_raise():
    """Random starts, too few starts, wrong boxes and wrong scales."""
    found = disc_and_rest(8)
    few = found._replace(data=found.data.stack(sample=("start.Y", "start.V")))
    for ask in (few.integrity, few.entropy, few.uncertainty):
        with pytest.raises(ValueError, match="starts on a grid"):
            ask()
    with pytest.raises(ValueError, match="16 starts at least"):
        found.uncertainty()
    with pytest.raises(ValueError, match="`box` must be at most 8"):
        found.entropy(box=9)
    with pytest.raises(ValueError, match="`scales` must name"):
        found.integrity(scales={"start.W": 1.0})
    with pytest.raises(ValueError, match="`scales` must be finite and in"):
        found.integrity(scales={"start.V": 0.0})
