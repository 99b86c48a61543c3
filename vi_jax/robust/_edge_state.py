"""`edge_state`: the motion on the boundary between two basins, by edge tracking."""

import equinox as eqx
import numpy as np

from .._checks import count, flag, host_side
from .._messages import ReportProgress, at_work, silent
from .._types import State
from ..flow import MethodLike
from ..machine import AbstractMachine, Summarized, in_rows, without_modes
from ..orbit import ALIKE, Orbit, map_state
from ._settling import (
    ELSEWHERE,
    INADMISSIBLE,
    RECORDED,
    RETURNS,
    SAME,
    Row,
    Rows,
    Settling,
    in_row,
    settling_on,
)

# Two starts on both sides of the boundary are bisected to this distance, relative to the motion's
# size, and followed until they are no longer the `SAME`: a choice. The edge lies between them.
_CLOSE = 1e-10

# Pieces of `RECORDED` cycles after which two neighbours are bisected again in any case: a choice.
_PIECES = 16

# The 0-1 test: the fewest section states, and the least correlation of time with the squared
# distance of a walk from its origin (1 for chaos, 0 for regular motions). Choices.
_FEWEST, _CORRELATION = 200, 0.7

# For a search the edge's motion must recur to within `ALIKE`, after a failed search a tenth of it;
# the orbit found may be farther off by this factor. A choice.
_FARTHER = 10.0


class EdgeState(Summarized):
    """The attractor of motions on the boundary between two basins."""

    orbit: Orbit | None
    """The unstable periodic motion, by `find_orbit`; `None` if none was found."""
    kind: str = eqx.field(static=True)
    """`"saddle"`, a periodic motion with one multiplier outside the unit circle; `"unstable"`, one
    with more of them; `"chaotic"`, by the 0-1 test of the motion along the edge; `"irregular"`,
    otherwise: a quasi-periodic edge, one of a longer period than `longest`, or one that settles
    more slowly than it was followed."""
    sections: State
    """Section states along the edge, arrays of shape (cycles,), each within 1e-5 of the boundary
    (relative, as `tolerance` of `edge_state`)."""
    machine: AbstractMachine
    """The machine of the basins on both sides."""

    def summary(self) -> str:
        """Describe the edge state in words."""
        cycles = len(in_rows(self.sections))
        if self.orbit is not None:
            return f"Edge state ({self.kind}), after {cycles} cycles along it\n{self.orbit}"
        return (
            f"Edge state ({self.kind}): no motion that repeats was met in {cycles} cycles along it"
        )


@host_side
def edge_state(
    machine: AbstractMachine,
    inside: Orbit | State,
    outside: Orbit | State,
    *,
    settle: int = 1000,
    tolerance: float = 1e-4,
    longest: int = 8,
    rounds: int = 60,
    method: MethodLike = None,
    progress: bool = True,
) -> EdgeState:
    """Find the edge state between two starts that settle on different motions.

    The line between the starts is bisected until two on both sides of the boundary are 1e-10 apart.
    These are followed until they are 1e-5 apart, and the line between them is bisected again. So
    the motion stays on the boundary and converges to an attractor within it (edge tracking: Skufca,
    Yorke and Eckhardt 2006). Once it comes near to an earlier state, `find_orbit` makes it exact.
    Host-side: not to be traced.

    **Arguments:**

    - `machine`: the machine.
    - `inside`: a stable `Orbit`, or a state from which the machine settles on a motion that repeats
      within `longest` cycles; for a machine without a drive also an equilibrium.
    - `outside`: an `Orbit` or a state from which it settles on any other motion.
    - `settle`: number of cycles after which a start that has not returned to the motion of `inside`
      counts as settling elsewhere.
    - `tolerance`: a start has returned once a section state is this close to one of the motion.
      It is relative to the sizes of the state's components, and must be smaller than the basin.
    - `longest`: longest period of the edge state, in cycles.
    - `rounds`: number of bisections after which the edge is called irregular.
    - `method`: as for `cycle_map`.
    - `progress`: whether to count the bisections, in a terminal or a notebook.

    **Returns:** an `EdgeState`.

    **Raises:** `ValueError` or `TypeError` for invalid arguments, and `ValueError` if both starts
    settle on the same motion. On Ctrl-C `Interrupted`, whose `partial` is an irregular `EdgeState`
    as far as the edge was followed.
    """
    progress = flag("progress", progress)
    longest, rounds = count("longest", longest, least=1), count("rounds", rounds, least=1)
    settling, start = settling_on(machine, inside, settle, tolerance, longest, method, "inside")
    outside_row = outside.state if isinstance(outside, Orbit) else outside
    outside_row = in_row(without_modes(map_state(settling.the_map.machine, outside_row, "outside")))
    first, second = settling.judge(np.stack([start, outside_row]))
    for name, verdict, wanted in (("inside", first, RETURNS), ("outside", second, ELSEWHERE)):
        if verdict == INADMISSIBLE:
            raise ValueError(f"Argument `{name}` must be a start that can be simulated.")
        if verdict != wanted:
            raise ValueError(
                "Arguments `inside` and `outside` must settle on different motions, but "
                f"`{name}` {'does not come' if wanted else 'comes'} back to that of `inside`. See "
                "`settle` and `tolerance`."
            )
    section_states: list[Rows] = []

    found = lambda: _described(settling, section_states, None) if section_states else None
    with at_work("edge", found, progress=progress, unit="round", total=rounds) as report:
        return track_edge(settling, start, outside_row, longest, rounds, section_states, report)


def track_edge(
    settling: Settling,
    inside: Row,
    outside: Row,
    longest: int,
    rounds: int,
    section_states: list[Rows] | None = None,
    report: ReportProgress = silent,
) -> EdgeState:
    """Find the edge state between a start that returns and one that does not. Extend
    `section_states`."""
    tolerance, section_states = ALIKE, [] if section_states is None else section_states
    for _ in range(rounds):
        inside, outside = settling.bisected(inside, outside, _CLOSE)
        pair, sections = _follow_pair(settling, np.stack([inside, outside]))
        if not len(sections):
            break
        section_states.append(sections)
        report(1)
        inside, outside = pair
        *before, last = np.concatenate(section_states)[-longest - 1 :]
        near = settling.motion.between(np.array(before), last)[::-1] <= tolerance if before else []
        if np.any(near):  # the motion has returned near to its state so many cycles before
            orbit = settling.orbit_near(last, int(np.argmax(near)) + 1, _FARTHER * tolerance)
            if orbit is not None and not bool(orbit.stable):
                return _described(settling, section_states, orbit)
            tolerance *= 0.1
    return _described(settling, section_states, None)


def _follow_pair(settling: Settling, pair: Rows) -> tuple[Rows, Rows]:
    """Follow two neighbours until they are apart; return them and their mean section states."""
    parts = []
    for _ in range(_PIECES):
        both = settling.section_states(pair, RECORDED)
        both[1] = settling.motion.near(both[1], both[0])
        separated = np.flatnonzero(~(settling.motion.between(both[1], both[0]) <= SAME))  # or NaN
        end = separated[0] if separated.size else RECORDED
        end = end if np.isfinite(both[:, end]).all() else end - 1
        parts.append(both[:, 1 : end + 1].mean(axis=0))
        pair = both[:, max(end, 0)]
        if separated.size:
            break
    return pair, np.concatenate(parts)


def _described(settling: Settling, section_states: list[Rows], orbit: Orbit | None) -> EdgeState:
    rows = (
        np.concatenate(section_states)
        if section_states
        else np.zeros((0, settling.motion.states.shape[1]))
    )
    if orbit is not None:
        outside = int(np.sum(np.abs(np.asarray(orbit.multipliers)) > 1))
        kind = "saddle" if outside == 1 else "unstable"
    else:
        late = rows[len(rows) // 4 :]
        kind = "chaotic" if _chaotic(settling.motion.near(late, late[-1:])) else "irregular"
    sections = settling.state(rows)
    return EdgeState(orbit, kind, sections, settling.the_map.machine)


def _chaotic(rows: Rows) -> bool:
    """Apply the 0-1 test for chaos (Gottwald and Melbourne 2009) to at least 200 section states."""
    count = len(rows)
    if count < _FEWEST:
        return False
    signal = rows[:, np.argmax(np.std(rows, axis=0))]
    signal = signal - signal.mean()
    lags, size = np.arange(1, count // 10 + 1), count - count // 10
    growths = []
    for rate in np.random.default_rng(0).uniform(np.pi / 5, 4 * np.pi / 5, 64):
        walk = np.cumsum(signal * np.exp(1j * rate * np.arange(1, count + 1)))
        spreads = np.array([np.mean(np.abs(walk[n : n + size] - walk[:size]) ** 2) for n in lags])
        growths.append(np.corrcoef(lags, spreads)[0, 1])
    return bool(np.median(growths) > _CORRELATION)
