"""A kernel's own memory, for arrays too large for registers: a vector of the group a number."""

from dataclasses import dataclass, field


class Arena:
    """Which places of a kernel's memory are in use while its text is written.

    Places are counted in vectors of eight-byte numbers, one for each lane of a group. What is let
    go of is given out again, lowest first, so that a step's arrays stay near each other.
    """

    def __init__(self) -> None:
        self.size = 0
        """The places that the kernel needs in all."""
        self._free: list[tuple[int, int]] = []  # from, to; in order, apart from each other

    def take(self, numbers: int) -> "Block":
        """Room for so many numbers of every lane, until nothing refers to the block any more."""
        for i, (begin, end) in enumerate(self._free):
            if end - begin >= numbers:
                rest = [(begin + numbers, end)] if end - begin > numbers else []
                self._free[i : i + 1] = rest
                return Block(self, begin, numbers)
        begin = self.size
        if self._free and self._free[-1][1] == self.size:
            begin = self._free.pop()[0]
        self.size = begin + numbers
        return Block(self, begin, numbers)

    def give_back(self, begin: int, end: int) -> None:
        """What `Block` calls as it goes."""
        kept = []
        for a, b in self._free:
            if b == begin:
                begin = a
            elif a == end:
                end = b
            else:
                kept.append((a, b))
        self._free = sorted([*kept, (begin, end)])


@dataclass(eq=False)
class Block:
    """Places of an arena, in use as long as this object is."""

    arena: Arena = field(repr=False)
    start: int
    numbers: int

    def __del__(self) -> None:
        self.arena.give_back(self.start, self.start + self.numbers)
