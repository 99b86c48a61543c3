"""`manifold`: the stable and the unstable manifold of a saddle of a planar section, as curves."""

from collections.abc import Iterator

import equinox as eqx
import numpy as np
from jaxtyping import Bool

from .._checks import flag, given_number, host_side, one_of
from .._messages import at_work
from .._types import State
from ..machine import AbstractMachine, Summarized, in_rows, is_autonomous, without_modes
from ..orbit import ALIKE, Orbit, cycle_map
from ._settling import SAME, Row, Rows, Settling, in_row, one_orbit

# The largest angle, in radians, of a curve's turn from point to point; the share of `spacing` to
# which points are set closer for a smaller turn. Choices.
_TURN, _CLOSEST = 0.15, 1 / 64

# Points of an arc in one program; its half angle; the rounds that narrow it; the margin of the next
# arc, in points. 6 rounds give an angle of 1e-9. Choices.
_ARC, _HALF, _ROUNDS, _WIDER = 64, 2.9, 6, 0.25

# Distance of the images of neighbours on an arc; largest distance of an image from the saddle; most
# growth of a difference until then. Choices.
_REACH, _FAR, _GROWTH = 0.1, 0.2, 1e6

# Two neighbours closer than this share of a period's stretch of an unstable manifold are on both
# sides of a jump; most points of a stretch. Choices.
_JUMP, _MOST = 1e-9, 4096


class Manifold(Summarized):
    """A stable or unstable manifold of a saddle on a planar section, both its branches."""

    orbit: Orbit
    """The saddle."""
    which: str = eqx.field(static=True)
    """`"stable"` or `"unstable"`."""
    branches: tuple[State, State]
    """Section states along each branch from the saddle on, arrays of shape (points,); NaN where a
    curve is cut at a jump of the section map."""
    lengths: tuple[float, float] = eqx.field(static=True)
    """Length of each branch, as `length` of `manifold`; less if the branch ends early."""
    machine: AbstractMachine
    """The machine of the saddle."""

    def summary(self) -> str:
        """Describe the branches in words."""
        parts = [
            f"length {length:.4g} ({len(in_rows(branch))} points)"
            for length, branch in zip(self.lengths, self.branches, strict=True)
        ]
        return f"{self.which.capitalize()} manifold of a saddle: {', '.join(parts)}"


@host_side
def manifold(
    orbit: Orbit,
    *,
    which: str = "stable",
    length: float = 2.0,
    spacing: float = 0.05,
    progress: bool = True,
) -> Manifold:
    """Compute the stable or unstable manifold of a saddle of a driven machine with two states.

    The stable manifold contains the states from which the machine goes to the saddle, and bounds
    basins near it. It is computed point by point, from the saddle on. The next point is on an arc
    ahead of the last one. It is the zero of w·(Pⁿ(x) - xₛ), with w the saddle's left unstable
    eigenvector and n as large as neighbours on the arc stay together. This needs neither an inverse
    nor a derivative of the section map, so the manifold continues through kinks at grazings. The
    unstable manifold, the states that come from the saddle, is the image of a short stretch along
    its eigenvector; points are added where the images separate or turn. Host-side: not to be
    traced.

    **Arguments:**

    - `orbit`: an orbit from `find_orbit`, with one multiplier outside the unit circle and one
      inside.
    - `which`: `"stable"` or `"unstable"`.
    - `length`: length of each branch, each component of the state relative to its size in the
      saddle's motion; for a `Scene` in its own units.
    - `spacing`: the greatest distance of neighbouring points, in the same norm. Points are closer,
      to a 64th of that, if the curve turns by more than 0.15 from one to the next.

    **Returns:** a `Manifold`. A branch of a stable manifold ends early at a stop, at a jump of the
    section map, or at a kink that turns by more than 166°; an unstable one continues after a jump.

    **Raises:** `ValueError` or `TypeError` for invalid arguments.
    """
    progress = flag("progress", progress)
    which = one_of("which", which, ("stable", "unstable"))
    length = given_number("length", length, low=0.0, open_low=True)
    spacing = given_number("spacing", spacing, low=0.0, open_low=True)
    orbit = one_orbit("orbit", orbit)
    sizes = np.abs(np.asarray(orbit.multipliers))
    if sizes.size != 2 or is_autonomous(orbit.machine, orbit.state):
        raise ValueError(
            "Argument `orbit` must be of a driven machine with two states, so that its section is "
            "a plane."
        )
    if not sizes[0] > 1 > sizes[1]:
        raise ValueError(
            "Argument `orbit` must be a saddle, one multiplier outside the unit circle and one "
            f"inside, but their sizes are {sizes[0]:.6g} and {sizes[1]:.6g}."
        )
    saddle = _Saddle(orbit)
    grow = _stable if which == "stable" else _unstable
    parts, lengths = ([saddle.place[None]], [saddle.place[None]]), [0.0, 0.0]

    def result() -> Manifold:
        first, second = (saddle.map.state(saddle.states(part)) for part in parts)
        return Manifold(orbit, which, (first, second), (lengths[0], lengths[1]), orbit.machine)

    found = lambda: result() if any(lengths) else None
    with at_work("manifold", found, progress=progress, unit="point") as report:
        for i, side in enumerate((1.0, -1.0)):
            for rows, lengths[i] in grow(saddle, side, length, spacing):
                parts[i].append(rows)
                report(len(rows))
    return result()


Pieces = Iterator[tuple[Rows, float]]
"""Further points of a curve from the saddle, and its length with them."""


class _Saddle:
    """A saddle on its section, with its directions; states are rows relative to their sizes."""

    def __init__(self, orbit: Orbit):
        the_map = cycle_map(orbit.machine, method=orbit.method)
        place = in_row(without_modes(orbit.state))
        self.map = Settling(the_map, without_modes(orbit.state), place[None], 1, 1.0)
        self.near, self.unit = self.map.motion.near, self.map.motion.sizes
        self.place = place / self.unit
        period = int(orbit.cycles)
        whole = cycle_map(orbit.machine, period, method=orbit.method)
        jacobian = np.asarray(whole.jacobian(orbit.state)) * self.unit / self.unit[:, None]
        values, right = np.linalg.eig(jacobian)
        order = np.argsort(-np.abs(values))
        growth = np.real(values[order])
        unstable, stable = (np.real(right[:, i]) for i in order)
        self.unstable, self.stable = (x / np.linalg.norm(x) for x in (unstable, stable))
        self.across = np.real(np.linalg.inv(right)[order[0]])
        # A negative multiplier changes sides; two periods do not.
        turns = 2 if growth[0] < 0 else 1
        self.period, self.growth = turns * period, float(np.abs(growth[0]) ** turns)

    def states_after(self, rows: Rows, periods: int) -> Rows:
        return self.map.states_after(rows * self.unit, periods * self.period) / self.unit

    def states(self, parts: list[Rows]) -> Rows:
        """Return points of a curve in original units, with NaN rows where an angle jumps a turn."""
        rows = np.concatenate(parts) * self.unit
        rows = self.near(rows, np.zeros_like(rows))
        jumps = np.abs(self.near(rows[1:], rows[:-1]) - rows[1:]) > 1
        return np.insert(rows, np.flatnonzero(jumps.any(axis=1)) + 1, np.nan, axis=0)

    def side_of(self, rows: Rows, distance: float) -> tuple[Row, Bool[np.ndarray, " _"]]:
        """Return w·(Pⁿ(x) - xₛ) of neighbours at this `distance`, and whether Pⁿ(x) is near xₛ."""
        largest = np.log(_GROWTH) / np.log(self.growth)
        periods = np.clip(np.log(_REACH / distance) / np.log(self.growth), 1, max(largest, 1))
        images = self.states_after(rows, int(periods))
        diff = self.near(images, self.place) - self.place
        return diff @ self.across, np.all(np.abs(diff) <= _FAR * (1 + np.abs(self.place)), axis=1)


def _stable(saddle: _Saddle, side: float, length: float, spacing: float) -> Pieces:
    direction_before = side * saddle.stable
    point, reached = saddle.place, 0.0
    step = spacing * _CLOSEST * 4
    while reached < length:
        size = min(step, length - reached + 1e-12)
        new = _next_point(saddle, point, direction_before, size)
        direction = direction_before if new is None else (new - point) / size
        turn = np.arccos(np.clip(direction @ direction_before, -1, 1))
        if (new is None or turn > _TURN) and step > spacing * _CLOSEST:
            step = max(step / 2, spacing * _CLOSEST)
            continue
        if new is None:
            break
        point, reached, direction_before = new, reached + size, direction
        yield new[None], reached
        step = min(spacing, step * (1.5 if turn < _TURN / 3 else 1.0))


def _next_point(saddle: _Saddle, point: Row, direction: Row, size: float) -> Row | None:
    """Return the point of the stable manifold at distance `size` ahead of `point`, or `None`."""
    middle, low, high = np.arctan2(direction[1], direction[0]), -_HALF, _HALF
    new = None
    for _ in range(_ROUNDS):
        turns = np.linspace(low, high, _ARC)
        angles, spacing = middle + turns, turns[1] - turns[0]
        rows = point + size * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        value, near = saddle.side_of(rows, size * spacing)
        # Far from the saddle the line on which w·(x - xₛ) is zero is not its manifold.
        change = np.flatnonzero((value[:-1] * value[1:] <= 0) & (near[:-1] | near[1:]))
        if not change.size:
            return None
        best = int(change[np.argmin(np.abs(turns[change]))])
        low, high = turns[best] - _WIDER * spacing, turns[best + 1] + _WIDER * spacing
        new = rows[best]
    return new


def _unstable(saddle: _Saddle, side: float, length: float, spacing: float) -> Pieces:
    """Yield one branch of an unstable manifold, with NaN rows at jumps."""
    # As far as it is straight: it deviates from its tangent by the square of this distance.
    begin = side * SAME * saddle.unstable
    reached, periods = 0.0, 0
    while reached < length and periods < 400:
        periods += 1
        rows, connected = _image_of_stretch(saddle, begin, periods, spacing)
        near = saddle.near(rows[1:], rows[:-1])
        steps = np.linalg.norm(near - rows[:-1], axis=1)
        steps[~connected] = 0.0
        arc_length = reached + np.concatenate([[0.0], np.cumsum(steps)])
        used = int(np.searchsorted(arc_length, length)) + 1
        cut = np.flatnonzero(~connected[: used - 1])
        if arc_length[-1] - reached < ALIKE * spacing and reached > spacing:
            break  # it has reached an attractor
        reached = float(min(arc_length[-1], length))
        yield np.insert(rows[:used], cut + 1, np.nan, axis=0), reached


def _image_of_stretch(
    saddle: _Saddle, begin: Row, periods: int, spacing: float
) -> tuple[Rows, Bool[np.ndarray, " _"]]:
    """Return images of a period's stretch along the eigenvector, and whether neighbours connect."""

    def images(parts):
        rows = saddle.place + begin * (saddle.growth**parts)[:, None]
        return saddle.states_after(rows, periods)

    parts = np.linspace(0, 1, 9)
    rows = images(parts)
    while True:
        steps = saddle.near(rows[1:], rows[:-1]) - rows[:-1]
        sizes = np.linalg.norm(steps, axis=1)
        wide = ~(sizes <= spacing)
        inner = np.sum(steps[1:] * steps[:-1], axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            bends = np.arccos(np.clip(inner / (sizes[1:] * sizes[:-1]), -1, 1)) > _TURN
        large = sizes > spacing * _CLOSEST
        wide[1:] |= bends & large[1:]
        wide[:-1] |= bends & large[:-1]
        jumps = np.diff(parts) < _JUMP
        split = np.flatnonzero(wide & ~jumps)
        if not split.size or len(parts) > _MOST:
            return rows, ~(jumps & ~(sizes <= spacing))
        new = 0.5 * (parts[split] + parts[split + 1])
        parts = np.insert(parts, split + 1, new)
        rows = np.insert(rows, split + 1, images(new), axis=0)
