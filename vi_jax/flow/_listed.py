"""The logs of a run in words: what happened in each cycle."""

from collections.abc import Callable

import numpy as np

from .._messages import so_many

# Cycles of which a text tells, and events of each.
_CYCLES, _EVENTS = 8, 6


def listed(what: str, used: object, word: Callable[[int, int], str]) -> str:
    """How many there are, and those of the first cycles one by one.

    **Arguments:** what is listed; which places of the log, (cycles, size) and batch axes before
    them, are used; and what stands at such a place, in words.
    """
    used = np.asarray(used)
    if used.ndim > 2:
        return f"{int(used.sum())} {what}s in lanes of shape {used.shape[:-2]}"
    many = so_many(int(used.sum()), what)
    lines = [f"{many} listed in {so_many(len(used), 'cycle')}"]
    some = np.flatnonzero(used.any(axis=1))
    for i in some[:_CYCLES]:
        places = np.flatnonzero(used[i])
        words = [word(int(i), int(j)) for j in places[:_EVENTS]]
        more = [f"and {len(places) - _EVENTS} more"] * (len(places) > _EVENTS)
        lines.append(f"  cycle {i + 1}: {', '.join([*words, *more])}")
    if len(some) > _CYCLES:
        lines.append(f"  and {len(some) - _CYCLES} more cycles")
    return "\n".join(lines)
