"""`grazing`: what a grazing leads to, by its local map and beside the machine itself."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from .._checks import count, flag, instance_of
from .._messages import Interrupted, at_work, so_many
from ..machine import Stated, Summarized, in_unit, stated, stops_of
from ._beside_grazing import ASKED, DECADES, Motions, beside_grazing, positions, stretch
from ._flight import Event
from ._forecast import (
    SCENARIOS,
    Settled,
    Windows,
    lanes_of,
    natural_depth,
    scenario_of,
    settled,
    windows,
)
from ._local_map import Graze, graze_at
from .results import complex_in_words
from .special import Point

# Of the depth at which windows end, or of that which a touch of so much of a cycle has, the
# greatest that is looked at; and values in each decade below it. Choices.
_DEEPEST, _BRIEF, _EACH = 0.1, 0.05, 144

# What an impact does is forgotten if what it adds to the distance later is this small a share: a
# choice, far above rounding (1e-28 for a van der Pol oscillator) and below all that was tried.
_VANISHES = 1e-14


class Grazing(Summarized):
    """The attractor beyond a grazing, from `grazing`. NumPy arrays in the machine's units, for m
    touches in a period (usually one) and n states."""

    parameter: str = eqx.field(static=True)
    """Name of the branch's parameter."""
    value: float
    """The parameter at the grazing."""
    touched: str = eqx.field(static=True)
    """What is touched, in words."""
    cycles: int = eqx.field(static=True)
    """Period of the motion that grazes, in cycles: the unit of all periods here."""
    matrix: Float[np.ndarray, "n n"]
    """N, the derivative of the motion's section map without the impact, from touch to touch at a
    fixed reading of the clock."""
    multipliers: Complex[np.ndarray, " n"]
    """Of N, the largest modulus first."""
    rate: Float[np.ndarray, " m"]
    """a, the second derivative of the distance to the stop by the clock, at each touch."""
    gradient: Float[np.ndarray, "m n"]
    """∂h, of that distance by the state."""
    kick: Float[np.ndarray, "m n"]
    """Change of the state by an impact, over the depth to the power of `order`; -√(2a) W for a
    rigid stop, whose impact adds W·dh/ds."""
    order: Float[np.ndarray, " m"]
    """1/2 for rigid and prestressed stops, 3/2 for a spring without prestress."""
    slope: Float[np.ndarray, " m"]
    """Derivative of the least distance by the parameter, along the motion without impact."""
    entries: Float[np.ndarray, " 12"]
    """eₙ = ∂h Nⁿ kick, n = 1, 2, …: what an impact of depth one adds to the distance n periods
    later. A motion with one impact in n periods needs eⱼ > 0 for 0 < j < n."""
    side: int
    """1 if impacts appear as the parameter rises, -1 if as it falls."""
    outcome: SCENARIOS
    """The scenario on that side, at the values in `checked`, or without a check at all values."""
    aperiodic: float
    """Share of these values, evenly spaced by their logarithm, without a period."""
    windows: Windows | None
    """Motions with one impact in n periods; `None` where there are several touches or no root."""
    forecast: Motions
    """The attractors of the local map."""
    machine: Motions | None
    """The attractors of the machine at some of these values; `None` without a check."""
    checked: tuple[float, float] | None
    """Distances from the grazing, in the parameter, between which the machine agrees with the
    forecast on both sides, except at edges of windows; `None` if nowhere, or without a check."""
    agreement: float
    """Share of the values there at which period and impacts are the same; NaN if none."""
    far: tuple[int, int] | None
    """Period in cycles and number of rigid impacts of the motion on which the machine settles, at
    most values, if no attractor is near. The period is 0 if none was found up to 64 periods of the
    motion that grazes. `None` if the machine stays near, or without a check."""
    labels: tuple[str, str] = eqx.field(static=True)
    """What pictures write beside position and velocity, in the machine's words."""
    units: Stated = eqx.field(static=True)
    """In which units its quantities are, as the machine states it."""

    def summary(self) -> str:
        """The stop, the local map, its attractor, and the agreement of the machine."""
        at = in_unit(f"{self.value:.10g}", dict(self.units), self.parameter)
        values = ", ".join(complex_in_words(z, 6, 1e-9) for z in self.multipliers)
        entries = ", ".join(f"{e:.4g}" for e in self.entries[:6])
        orders = ", ".join(f"{x:g}" for x in self.order)
        lines = [
            f"Grazing at {self.parameter} = {at}: touches the {self.touched}",
            f"  what follows: {SCENARIOS[self.outcome]}",
            *([] if self.far is None else [f"  far away: the machine settles on {self.afar}"]),
            f"  impacts appear: as {self.parameter} {'rises' if self.side > 0 else 'falls'}",
            f"  multipliers without impact: {values}",
            f"  second derivative of the distance: {', '.join(f'{a:.6g}' for a in self.rate)}",
            f"  power of the depth: {orders}",
            f"  entries: {entries}, …",
            f"  values without a period: {100 * self.aperiodic:.3g} %",
            *self._windows_in_words(),
        ]
        if self.checked is not None:
            low, high = (f"{x:.3g}" for x in self.checked)
            lines.append(
                f"  checked by the machine: from {low} to {high} on both sides, "
                f"{100 * self.agreement:.3g} % of the values alike"
            )
        elif self.machine is not None:
            lines.append("  checked by the machine: it does not agree at the values looked at")
        return "\n".join(lines)

    @property
    def afar(self) -> str:
        """The motion of the machine where nothing near attracts, `far` in words; "" if `None`."""
        if self.far is None:
            return ""
        period, impacts = self.far
        if not period:
            return "no short period"
        return f"a motion of {so_many(period, 'cycle')} with {so_many(impacts, 'impact')}"

    def _windows_in_words(self) -> list[str]:
        if self.windows is None:
            return []
        lines, least = [], np.abs(self.forecast.offset).min()
        for n, (near, far) in zip(self.windows.period, self.windows.stable, strict=True):
            if np.isfinite(near) and abs(far) > least:  # further ones are too close to tell apart
                place = in_unit(f"{near:+.3g} … {far:+.3g}", dict(self.units), self.parameter)
                each = f"{n} periods" if n > 1 else "each period"
                lines.append(f"  one impact in {each}: stable at {place} from there")
        return lines

    def drawn(self):
        """The period at each value, as the local map has it."""
        return self.forecast.period


def grazing(
    point: Point, *, check: bool = True, periods: int = 12, progress: bool = True
) -> Grazing:
    """Predict the attractor beyond a grazing of a branch from its local map.

    The motion that grazes has a smooth section map without the impact. The discontinuity mapping
    corrects a neighbour that would pass the stop (Nordmark 1991; di Bernardo, Budd, Champneys and
    Kowalczyk 2008), by the root of the depth at a rigid stop. Both are derivatives of the machine's
    functions, for rigid, soft and prestressed stops and for autonomous machines. The map is
    iterated over decades of the parameter and its attractor is named. The machine itself is
    simulated at the same values, on both sides. Host-side: not to be traced.

    **Arguments:**

    - `point`: a special point of a branch of the kind "grazing" (`Branch.special`).
    - `check`: whether to simulate the machine for comparison, which takes most of the time.
    - `periods`: motions with one impact in up to so many periods are listed.
    - `progress`: show a bar while the machine is simulated, in a terminal or a notebook.

    **Returns:** a `Grazing`.

    **Raises:** `TypeError` if this is no special point; `ValueError` if it is of another kind, if
    nothing is touched there, if an event is touched whose jump does not vanish with the speed, or
    if the motion without the impact has a fold there; on Ctrl-C while the machine is simulated
    `Interrupted`, whose `partial` is what `check=False` gives.
    """
    instance_of("point", point, Point, "a `Point`, from `Branch.special`")
    check, periods = flag("check", check), count("periods", periods, least=1)
    progress = flag("progress", progress)
    graze = graze_at(point)
    unchecked, settles = _unchecked(graze, periods)
    if not check:
        return unchecked
    offsets = unchecked.forecast.offset[::ASKED]
    with at_work(
        "grazing", lambda: Interrupted("check of the grazing", unchecked),
        progress=progress, unit="value", total=len(offsets),
    ) as tell:  # fmt: skip
        some = lanes_of(settles, slice(None, None, ASKED))
        beside, same, far = beside_grazing(graze, offsets, some)
        checked, agreement = stretch(np.abs(offsets), *same)
        tell(len(offsets))
    found = dataclasses.replace(
        unchecked, machine=beside, checked=checked, agreement=agreement, far=far
    )
    return found if checked is None else _within(found, graze, settles, checked)


def _within(
    found: Grazing, graze: Graze, settles: Settled, checked: tuple[float, float]
) -> Grazing:
    """The same, what follows named for the values at which the machine agrees alone: elsewhere the
    local map may go through other things than the machine does."""
    size = np.abs(found.forecast.offset)
    inside = (size >= checked[0]) & (size <= checked[1])
    some = lanes_of(settles, inside)
    outcome, aperiodic = scenario_of(graze.map, found.forecast.offset[inside], some)
    return dataclasses.replace(found, outcome=getattr(SCENARIOS, outcome), aperiodic=aperiodic)


def _unchecked(graze: Graze, periods: int) -> tuple[Grazing, Settled]:
    """What the local map forecasts of a grazing, not yet compared with the machine; and what it
    settles on at each value of the parameter."""
    local, machine = graze.map, graze.problem.machine
    first = graze.touches[0]
    natural, brief = natural_depth(local), _brief_depth(graze)
    if natural < _VANISHES * brief:
        raise ValueError(
            "Argument `point` must be a grazing whose impacts come back to the stop, but here what "
            "they do is forgotten within a period to first order, as of an autonomous machine with "
            "one degree of freedom, where they only shift the time."
        )
    deepest = _DEEPEST * min(natural, brief)
    side = -1 if first.slope > 0 else 1
    offsets = side * deepest / abs(first.slope) * np.logspace(-DECADES, 0, DECADES * _EACH + 1)
    found = settled(local, offsets)
    outcome, aperiodic = scenario_of(local, offsets, found)
    single = len(graze.touches) == 1 and first.kick.order == 0.5
    values = np.linalg.eigvals(local.matrix)
    names = sorted({_called(graze, t.number) for t in graze.touches})
    unchecked = Grazing(
        parameter=graze.problem.parameters[0],
        value=float(graze.x[-1]),
        touched=" and the ".join(names),
        cycles=graze.problem.cycles,
        matrix=local.matrix,
        multipliers=values[np.argsort(-np.abs(values))].astype(complex),
        rate=np.array([t.rate for t in graze.touches]),
        gradient=local.gradients,
        kick=local.kicks,
        order=local.orders,
        slope=local.slopes,
        entries=local.entries(12),
        side=side,
        outcome=getattr(SCENARIOS, outcome),
        aperiodic=aperiodic,
        windows=windows(local, deepest, periods) if single else None,
        forecast=Motions(
            offsets, found.period, found.impacts,
            positions(graze, offsets, found.places @ graze.section.matrix.T),
        ),
        machine=None,
        checked=None,
        agreement=np.nan,
        far=None,
        labels=machine.labels,
        units=stated(machine),
    )  # fmt: skip
    return unchecked, found


def _called(graze: Graze, number: int) -> str:
    """What is touched, in words."""
    machine = graze.problem.machine
    if number >= len(stops_of(machine)):
        return Event(number).called(machine)
    stop = stops_of(machine)[number]
    return stop.name or f"{stop.side} stop"


def _brief_depth(graze: Graze) -> float:
    """The depth of a passage beyond the stop that lasts a small share of a cycle."""
    problem = graze.problem
    half = 0.5 * _BRIEF * float(problem.period(jnp.asarray(graze.x))) / problem.cycles
    return 0.5 * graze.touches[0].rate * half**2
