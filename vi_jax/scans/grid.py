"""The grid of a scan, the blocks in which it is computed and stored, and the noise of its lanes, a
path of its own for each by its number in the grid."""

import dataclasses
import itertools
import math
import reprlib
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, UInt32

from .._checks import row_of_numbers
from ..flow import WhiteNoise, lane_key, words_of

# The number of a lane among its values, where it has one: no name of an axis.
LANE = "lane number"


def axes_of(axes: Mapping[str, Any], argument: str = "axes") -> dict[str, np.ndarray]:
    """The axes as rows of numbers. **Raises:** `ValueError` that names the axis, or `TypeError` for
    what is no mapping."""
    if not isinstance(axes, Mapping) or not axes:
        raise TypeError(
            f"Argument `{argument}` must map names of numbers to rows of values, such as "
            f'{{"drive.frequency_ratio": [0.8, 0.9]}}, but got {axes!r}.'
        )
    found = {}
    for name, values in axes.items():
        row = row_of_numbers(values)
        if row is None:
            raise ValueError(
                f"Axis {name!r} must be one row of finite real numbers, but got "
                f"{reprlib.repr(values)}."
            )
        found[str(name)] = row
    return found


class Blocks:
    """A grid cut into rectangles of at most so many lanes, contiguous in the grid's order. If its
    axes are `paired`, their values are taken together, one lane for each place in the rows. With
    `numbers`, one for each lane in the grid's order, they are among the lanes' values."""

    def __init__(
        self,
        axes: Mapping[str, np.ndarray],
        lanes: int,
        *,
        paired: bool = False,
        numbers: np.ndarray | None = None,
    ):
        self.axes, self.paired, self.lanes = dict(axes), paired, lanes
        self.dims = ("sample",) if paired else tuple(axes)
        self.shape = tuple(x.size for x in axes.values())[: 1 if paired else None]
        room = lanes
        block = []
        for size in reversed(self.shape):
            block.append(min(size, room))
            room //= min(size, room)
        self.block = tuple(reversed(block))
        self.numbers = None if numbers is None else numbers.reshape(self.shape)

    @property
    def total(self) -> int:
        """Number of lanes in the whole grid."""
        return math.prod(self.shape)

    def dims_of(self, name: str) -> tuple[str]:
        """The dimension along which an axis' values lie."""
        return ("sample",) if self.paired else (name,)

    def __len__(self) -> int:
        return math.prod(map(len, self._edges()))

    def __iter__(self) -> Iterator[tuple[slice, ...]]:
        """Where each block lies in the grid."""
        pairs = zip(self._edges(), self.block, self.shape, strict=True)
        rows = ([slice(i, min(i + n, size)) for i in edges] for edges, n, size in pairs)
        return itertools.product(*rows)

    def _edges(self) -> list[range]:
        return [range(0, size, n) for size, n in zip(self.shape, self.block, strict=True)]

    def values(self, where: tuple[slice, ...]) -> dict[str, np.ndarray]:
        """The axes' values of the block's lanes, and their numbers as `LANE`."""
        beside = {} if self.numbers is None else {LANE: self.numbers[where].ravel()}
        if self.paired:
            return {name: x[where] for name, x in self.axes.items()} | beside
        rows = [x[part] for x, part in zip(self.axes.values(), where, strict=True)]
        grid = np.meshgrid(*rows, indexing="ij")
        return {name: x.ravel() for name, x in zip(self.axes, grid, strict=True)} | beside


# What the name of an axis begins with, of a number of the start and of one of the noise; one of the
# machine has no prefix.
MACHINE, START, NOISE = "", "start.", "noise."


def part_of(name: str) -> str | None:
    """What an axis or a derivative is of: `MACHINE`, `START` or `NOISE`; `None` for `LANE`."""
    if name == LANE:
        return None
    return next((prefix for prefix in (START, NOISE) if name.startswith(prefix)), MACHINE)


class LaneNoise(eqx.Module):
    """The noise of a scan."""

    noise: WhiteNoise
    key: UInt32[Array, "2"]
    """The words of its key, of which each lane's is made."""

    def noise_of(
        self, values: Mapping[str, Any], names: tuple[str, ...] = (), nudge: Array | None = None
    ) -> WhiteNoise:
        """The noise of the lane with these values on the axes; `nudge` is added to the numbers
        (`names`) by which is differentiated."""
        amplitudes = dict(self.noise.amplitudes)
        for name, value in values.items():
            if part_of(name) == NOISE and (own := name.removeprefix(NOISE)) in amplitudes:
                amplitudes[own] = value
        for name, change in zip(names, () if nudge is None else nudge, strict=nudge is not None):
            if part_of(name) == NOISE:
                own = name.removeprefix(NOISE)
                amplitudes[own] = amplitudes[own] + change
        amplitudes |= dict(self.noise.functions)
        return dataclasses.replace(self.noise, amplitudes=amplitudes)

    def lane(
        self, values: Mapping[str, Any], names: tuple[str, ...] = (), nudge: Array | None = None
    ) -> tuple[WhiteNoise, Array]:
        """Noise and key of a lane, whose number is among its values; arguments as `noise_of`."""
        number = jnp.asarray(values[LANE], jnp.uint32)
        return self.noise_of(values, names, nudge), lane_key(self.key, number)

    def described(self) -> dict[str, Any]:
        """What makes two noises the same, as JSON can hold it."""
        sizes = {name: np.asarray(x).tolist() for name, x in self.noise.amplitudes.items()}
        words = [f"{int(word):08x}" for word in np.asarray(self.key)]
        return {"amplitudes": sizes, "impulses": self.noise.impulses, "key": " ".join(words)}


def lane_noise_of(
    noise: object, key: object, axes: Iterable[str] = (), derivatives: Iterable[str] = ()
) -> LaneNoise | None:
    """The noise of a scan, `None` for none; `axes` and `derivatives` are names. **Raises:**
    `TypeError` or `ValueError` for what does not fit together."""
    given = {"axes": axes, "derivatives": derivatives}
    names = [
        (which, name) for which, row in given.items() for name in row if part_of(name) == NOISE
    ]
    if noise is None:
        if key is not None or names:
            what = "`key`" if key is not None else f"`{names[0][0]}`, which names {names[0][1]!r},"
            raise ValueError(f"Argument {what} needs noise: give `noise`, a `WhiteNoise`.")
        return None
    if not isinstance(noise, WhiteNoise):
        raise TypeError(f"Argument `noise` must be a `WhiteNoise`, but got {noise!r}.")
    for which, name in names:
        offered = [NOISE + x for x in (*noise.amplitudes, *(["path"] if which == "axes" else []))]
        if name not in offered:
            raise ValueError(
                f"Argument `{which}` must name a number of the noise ({', '.join(offered)}), but "
                f"got {name!r}."
            )
    return LaneNoise(noise, words_of(key))
