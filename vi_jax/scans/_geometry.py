"""Geometry of basins from labels on a grid: entropies, uncertainty exponent, largest balls."""

import itertools
from typing import NamedTuple

import numpy as np

from ..machine import without_turns

# The number of distances, and the longest as a share of the grid. Choices.
_DISTANCES, _FARTHEST = 8, 1 / 16


class BasinEntropy(NamedTuple):
    """Basin entropy, after Daza, Wagemakers, Georgeot, Guéry-Odelin and Sanjuán, Scientific
    Reports 6, 31416 (2016)."""

    total: float
    """S_b: mean over all boxes of -Σ p ln p, with p the shares of the outcomes in a box."""
    boundary: float
    """S_bb: the same mean over the boxes with at least two outcomes; NaN without such a box. Above
    ln 2 the boundary is fractal; below, it may be either."""
    boxes: int
    """Number of boxes with starts."""
    boundary_boxes: int
    """Number of boxes with at least two outcomes."""
    box: int
    """Starts along each side of a box."""


class Uncertainty(NamedTuple):
    """Final-state sensitivity, after Grebogi, McDonald, Ott and Yorke, Physics Letters A 99, 415
    (1983). The share of starts whose outcome may change by an error ε grows as a power of ε.

    The error is in a single component of the start. The exponent is 1 across a smooth boundary.
    Across a fractal one it is the dimension of the starts minus that of the boundary. A boundary
    may be smooth in one direction and fractal in another: the smallest exponent decides as ε → 0.
    """

    exponents: np.ndarray
    """The exponent for errors along each axis of the grid, shape (axes,); NaN if fewer than three
    distances meet a boundary."""
    distances: np.ndarray
    """The errors ε, in cells of the grid; shape (distances,)."""
    fractions: np.ndarray
    """The share of starts with another outcome at this distance along an axis; (axes,
    distances)."""

    @property
    def exponent(self) -> float:
        """The smallest of `exponents`."""
        known = self.exponents[~np.isnan(self.exponents)]
        return float(known.min()) if known.size else np.nan


class Ball(NamedTuple):
    """A ball of starts with the same outcome."""

    radius: float
    centre: np.ndarray
    at_edge: bool
    """True if the edge of the region limits it, so that it might be larger."""


def entropy_of(label: np.ndarray, *, box: int, is_start: np.ndarray | None = None) -> BasinEntropy:
    """Return the basin entropy of labels on a grid of any dimension, by separate boxes of `box`
    cells along each side; remaining cells at the ends of the axes are left out. `is_start` is True
    for cells with a start (all by default)."""
    is_start = np.ones(label.shape, bool) if is_start is None else is_start
    cells, starts = _boxes(label, box), _boxes(is_start, box)
    counts = starts.sum(axis=1)
    cells, starts, counts = cells[counts > 0], starts[counts > 0], counts[counts > 0]
    entropy, outcomes = np.zeros(len(counts)), np.zeros(len(counts), int)
    for number in np.unique(cells[starts]):
        share = np.sum((cells == number) & starts, axis=1) / counts
        entropy -= share * np.log(np.where(share > 0, share, 1.0))
        outcomes += share > 0
    mixed = outcomes > 1
    return BasinEntropy(
        total=float(entropy.mean()) if len(counts) else np.nan,
        boundary=float(entropy[mixed].mean()) if mixed.any() else np.nan,
        boxes=len(counts),
        boundary_boxes=int(mixed.sum()),
        box=box,
    )


def _boxes(cells: np.ndarray, box: int) -> np.ndarray:
    counts = [size // box for size in cells.shape]
    whole = cells[tuple(slice(n * box) for n in counts)]
    split = whole.reshape([part for n in counts for part in (n, box)])
    first = range(0, 2 * cells.ndim, 2)
    return split.transpose([*first, *(i + 1 for i in first)]).reshape(-1, box**cells.ndim)


def uncertainty_of(label: np.ndarray, *, is_start: np.ndarray | None = None) -> Uncertainty:
    """Return the uncertainty exponents of the boundaries between labels on a grid of any dimension;
    `is_start` is True for cells with a start (all by default); other cells have no outcome.

    The distances are eight, in cells, from 1 to a sixteenth of the shortest axis, at least 3. The
    starts are those with neighbours at the largest distance. An exponent is the slope of
    ln(fraction) over ln(distance) by least squares.
    """
    is_start = np.ones(label.shape, bool) if is_start is None else is_start
    farthest = max(int(min(label.shape) * _FARTHEST), 3)
    distances = np.unique(np.geomspace(1, farthest, _DISTANCES).round().astype(int))
    margin = int(distances.max())
    inner = tuple(slice(margin, size - margin) for size in label.shape)
    starts = max(np.count_nonzero(is_start[inner]), 1)
    fractions = np.empty((label.ndim, distances.size))
    for axis, i in np.ndindex(fractions.shape):
        found = _labels_differ(label, is_start, axis, int(distances[i]))
        fractions[axis, i] = np.count_nonzero(found[inner]) / starts
    exponents = np.array([_power(distances, row) for row in fractions])
    return Uncertainty(exponents, distances, fractions)


def _power(distances: np.ndarray, fractions: np.ndarray) -> float:
    used = fractions > 0
    if used.sum() < 3:
        return np.nan
    across, up = np.log(distances[used]), np.log(fractions[used])
    x, y = across - across.mean(), up - up.mean()
    return float(x @ y / (x @ x))


def _labels_differ(label: np.ndarray, is_start: np.ndarray, axis: int, distance: int) -> np.ndarray:
    found = np.zeros(label.shape, bool)
    low = (slice(None),) * axis + (slice(None, -distance),)
    high = (slice(None),) * axis + (slice(distance, None),)
    differ = (label[low] != label[high]) & is_start[low] & is_start[high]
    found[low] |= differ
    found[high] |= differ
    return found


class Cells(NamedTuple):
    """The cells of a grid, in which distances are measured."""

    centres: list[np.ndarray]
    """The centres along each axis, equally spaced."""
    scales: np.ndarray
    """The unit of distance along each axis."""
    ends: np.ndarray
    """True for the low and the high edge of each axis if it ends a ball; shape (axes, 2)."""
    angles: np.ndarray = np.array(False)
    """True for axes that are angles, modulo whole turns."""

    @property
    def widths(self) -> np.ndarray:
        return np.array([(x[-1] - x[0]) / (x.size - 1) for x in self.centres])

    @property
    def edges(self) -> np.ndarray:
        """The low and high edge of each axis; shape (axes, 2)."""
        half = 0.5 * self.widths
        return np.array([(x[0] - h, x[-1] + h) for x, h in zip(self.centres, half, strict=True)])

    @property
    def round(self) -> np.ndarray:
        """True for axes that are angles of a whole turn, whose edges coincide."""
        return self.angles & np.isclose(np.ptp(self.edges, axis=1), 2 * np.pi)

    def inside(self, point: np.ndarray) -> np.ndarray:
        """Return a point with its angles in the turn that begins at the low edge."""
        low = self.edges[:, 0]
        return np.where(self.angles, low + (point - low) % (2 * np.pi), point)

    def to_edge(self, point: np.ndarray) -> float:
        """Return the distance of a point from the edges that end a ball."""
        distance = np.abs(self.edges - point[:, None]) / self.scales[:, None]
        return float(np.min(distance[self.ends], initial=np.inf))


def ball_around(point: np.ndarray, foreign: np.ndarray, cells: Cells) -> Ball:
    """Return the largest ball around a point without foreign cells, of another outcome, or edges. A
    cell is a box around its start, and all of it counts as foreign. The radius is NaN for a point
    outside of the region."""
    low, high = cells.edges.T
    if not ((point >= low) & (point <= high)).all():
        return Ball(np.nan, point, False)
    square = np.zeros(foreign.shape)
    parts = zip(cells.centres, point, cells.widths, cells.scales, cells.round, strict=True)
    for axis, (row, x, width, scale, round_) in enumerate(parts):
        offset = without_turns(row - x) if round_ else row - x
        gap = np.maximum(np.abs(offset) - width / 2, 0.0) / scale
        square += (gap**2).reshape([-1 if i == axis else 1 for i in range(foreign.ndim)])
    nearest = float(np.sqrt(np.min(square[foreign], initial=np.inf)))
    edge = cells.to_edge(point)
    return Ball(min(edge, nearest), point, edge < nearest)


def largest_ball(own: np.ndarray, foreign: np.ndarray, cells: Cells) -> Ball:
    """Return the largest ball around a start of one outcome, or a corner or face of its cell,
    without foreign cells or edges, by an exact Euclidean distance transform. At least one cell is
    `own`. Cells that are neither contain no start, and do not end a ball."""
    from scipy.ndimage import distance_transform_edt  # slow to load

    # Angles are extended periodically by half a turn on both sides.
    padding = np.where(cells.round, np.array(own.shape) // 2 + 1, 0)
    own = np.pad(own, [(n, n) for n in padding])
    foreign = np.pad(foreign, [(n, n) for n in padding], mode="wrap")
    # On a lattice of half the spacing, the point of a box nearest to any node is itself a node.
    shape = tuple(2 * size + 1 for size in own.shape)
    free, is_centre = np.ones(shape, bool), np.zeros(shape, bool)
    for offset in itertools.product((0, 1, 2), repeat=own.ndim):
        nodes = tuple(slice(o, o + 2 * n - 1, 2) for o, n in zip(offset, own.shape, strict=True))
        free[nodes] &= ~foreign
        is_centre[nodes] |= own
    for axis, side in np.argwhere(cells.ends):
        free[(slice(None),) * int(axis) + (-int(side),)] = False
    low, half = cells.edges[:, 0], cells.widths / 2
    if free.all():
        return Ball(np.inf, cells.edges.mean(axis=1), False)
    distance = distance_transform_edt(free, sampling=list(half / cells.scales))
    radius = np.where(is_centre, np.asarray(distance, float), -1.0)
    node = np.array(np.unravel_index(int(np.argmax(radius)), shape))
    largest, centre = float(radius.max()), low + (node - 2 * padding) * half
    return Ball(largest, centre, cells.to_edge(centre) <= largest * (1 + 1e-9))
