"""The grid of a scan, and the blocks in which it is computed and stored."""

import math
import reprlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from .._checks import row_of_numbers

# The number of a lane among its values, where it has one: no name of an axis.
LANE = "lane number"


def axes_of(axes: Mapping[str, Any], argument: str = "axes") -> dict[str, np.ndarray]:
    """The axes as rows of numbers.

    **Raises:** `ValueError` that names the axis, or `TypeError` for what is no mapping.
    """
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
    """A grid cut into rectangles of at most so many lanes, contiguous in the grid's order.

    If its axes are `paired`, their values are taken together, one lane for each place in the rows.
    With `numbers`, one for each lane in the grid's order, they are among the lanes' values.
    """

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
        self.counts = tuple(
            math.ceil(size / part) for size, part in zip(self.shape, self.block, strict=True)
        )
        self.numbers = None if numbers is None else numbers.reshape(self.shape)

    @property
    def total(self) -> int:
        """Number of lanes in the whole grid."""
        return math.prod(self.shape)

    def dims_of(self, name: str) -> tuple[str]:
        """The dimension along which an axis' values lie."""
        return ("sample",) if self.paired else (name,)

    def __len__(self) -> int:
        return math.prod(self.counts)

    def __iter__(self) -> Iterator[tuple[slice, ...]]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: int) -> tuple[slice, ...]:
        """Where the block lies in the grid."""
        if not 0 <= index < len(self):
            raise IndexError(index)
        corner = np.unravel_index(index, self.counts)
        return tuple(
            slice(int(c) * part, min(size, (int(c) + 1) * part))
            for c, part, size in zip(corner, self.block, self.shape, strict=True)
        )

    def values(self, where: tuple[slice, ...]) -> dict[str, np.ndarray]:
        """The axes' values of the block's lanes, and their numbers as `LANE`."""
        beside = {} if self.numbers is None else {LANE: self.numbers[where].ravel()}
        if self.paired:
            return {name: x[where] for name, x in self.axes.items()} | beside
        rows = [x[part] for x, part in zip(self.axes.values(), where, strict=True)]
        grid = np.meshgrid(*rows, indexing="ij")
        return {name: x.ravel() for name, x in zip(self.axes, grid, strict=True)} | beside
