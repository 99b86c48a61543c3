"""Why a simulation ended, and what it returns."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from ..scene.numbers import by_name
from .labelled import in_names, place_of, run_dataset


class RESULTS(eqx.Enumeration):
    """Why a lane ended; `simulate` gives one to each."""

    successful = ""
    bad_start = (
        "The start or a number of the scene is not finite or out of its range, or the start lies "
        "beyond a stop."
    )
    stalled = (
        "The crank stopped turning forward, which the phase clock cannot follow. Simulate with "
        '`clock="time"`.'
    )
    chatter = (
        "The impacts within one cycle exceeded `max_impacts`, or followed each other too fast to "
        "be told apart (chatter)."
    )
    underflow = "The step size fell below what the precision resolves. Loosen the tolerance."
    not_finite = "The state ceased to be finite."
    unresolved = "An impact could not be located within the step."
    max_steps = (
        "The number of steps exceeded `max_steps` before the last cycle was complete, or 65,536 "
        "within one, as where an autonomous machine is at rest and meets its section no more."
    )


# The loop carries reasons as numbers; this is their order.
REASON_NAMES = (
    "successful",
    "bad_start",
    "stalled",
    "chatter",
    "underflow",
    "not_finite",
    "unresolved",
    "max_steps",
)
REASONS = tuple(getattr(RESULTS, name) for name in REASON_NAMES)
(
    SUCCESSFUL,
    BAD_START,
    STALLED,
    CHATTER,
    UNDERFLOW,
    NOT_FINITE,
    UNRESOLVED,
    MAX_STEPS,
) = range(len(REASONS))


def reason(code: Float[Array, ""]) -> RESULTS:
    """The enumeration item for a reason carried as a number."""
    result = REASONS[0]
    for number, item in enumerate(REASONS[1:], start=1):
        result = RESULTS.where(code == number, item, result)
    return result


def number_of(result: RESULTS) -> Int[Array, "..."]:
    """The place of a reason in `REASONS`; 0 is success."""
    return place_of(result, REASONS)


class Samples(eqx.Module):
    """Dense samples, evenly spaced in the cycle; arrays have shape (cycles · samples + 1,)."""

    cycles: Float[Array, " points"]
    """Place of the sample on the drive's clock, in cycles since the start."""
    time: Float[Array, " points"]
    """Time τ since the start (in units of `s` for scenes of your own)."""
    state: Any
    """The states, a pytree like the start."""


class ImpactLog(eqx.Module):
    """The first impacts of each cycle in their order; arrays have shape (cycles, size).

    Unused places hold NaN, and -1 in `stop`.
    """

    phase: Float[Array, "cycles size"]
    """Clock of the cycle at the impact: crank angle in [0, 2π] for a `Scene`."""
    speed: Float[Array, "cycles size"]
    """V⁻, speed of approach just before the impact (unit: a ω)."""
    stop: Int[Array, "cycles size"]
    """Index into `scene.stops`."""


class Errors(eqx.Module):
    """Estimated errors of a run: its differences to a run by the method's `tighter` one.

    NaN where either run failed. Where a motion is chaotic they grow until they are as large as the
    motion. Under `vmap` batch axes come first.
    """

    sections: Any
    """Of the section states, a pytree like them; leaves (cycles + 1,)."""
    y_max: Float[Array, " cycles"] | None
    """Of the greatest Y in each cycle."""
    y_min: Float[Array, " cycles"] | None
    """Of the smallest Y in each cycle."""
    impacts: Int[Array, " cycles"]
    """Difference of the impact counts in each cycle."""


class Run(eqx.Module):
    """What `simulate` returns, cycle by cycle. After a failure the rest is NaN (counts: 0).

    Under `vmap` every array has the batch axes in front.
    """

    sections: Any
    """States at the start and after each cycle, a pytree like the start; leaves (cycles + 1,)."""
    y_max: Float[Array, " cycles"] | None
    """Greatest Y of the motion in each cycle, not of sample points (unit: a)."""
    y_min: Float[Array, " cycles"] | None
    """Smallest Y of the motion in each cycle (unit: a)."""
    impacts: Int[Array, " cycles"]
    """Number of impacts in each cycle."""
    impact_speed: Float[Array, " cycles"] | None
    """Greatest V⁻ in each cycle (unit: a ω), 0 without impact."""
    rests: Int[Array, " cycles"] | None
    """Times the body came to rest on a stop, its endless last impacts completed at once (they are
    not among `impacts`)."""
    impact_energy: Float[Array, " cycles"] | None
    """Energy lost in impacts in each cycle, Σ ½(1 - k²)V⁻², and ½V⁻² where the body came to rest
    (unit: m_C a²ω²)."""
    clearance: Float[Array, " cycles"] | None
    """Smallest distance to a stop at which the body turned back in each cycle without touching it
    (unit: a), infinite where it did not; recorded along with the impact log."""
    duration: Float[Array, " cycles"] | None
    """Time τ that each cycle took."""
    frequency_ratio: Float[Array, " cycles"] | None
    """ζ: mean crank speed over each cycle (unit: ω)."""
    samples: Samples | None
    """Dense samples, if asked for."""
    impact_log: ImpactLog | None
    """The impacts, if asked for."""
    errors: Errors | None
    """Estimated errors, if asked for."""
    result: RESULTS
    """Why the run ended: `RESULTS.successful`, or what went wrong."""
    steps: Int[Array, ""]
    """Steps tried, those included that were rejected or shortened to meet an impact (in single
    precision no more than 2²⁴ are seen)."""
    rejected: Int[Array, ""]
    """Steps rejected on their error estimate."""

    @property
    def successful(self) -> jax.Array:
        """Whether the lane completed all its cycles."""
        return self.result == RESULTS.successful

    @property
    def last(self) -> Any:
        """The state on the last section: a start to go on from, or a guess for `find_orbit`."""
        return jtu.tree_map(lambda x: x[..., -1], self.sections)

    def to_xarray(self, dims: Sequence[str] | None = None) -> Any:
        """This run as an `xarray.Dataset`, labelled by cycle, section and sample.

        States become a variable for each component: `section_Y` (cycles + 1), `sample_Y`; the
        impact log `log_phase`, `log_speed` and `log_stop`; all else keeps its name, and `result`
        is the reason's. Host-side: not to be traced.

        **Arguments:** names of the batch axes of a run under `vmap`; by default `lane`.

        **Raises:** `ValueError` if these are not as many as there are batch axes.
        """
        return run_dataset(self, dims, in_names(self.result, RESULTS, REASON_NAMES))

    def __str__(self) -> str:
        if isinstance(self.steps, Tracer):
            return repr(self)
        if self.steps.ndim:
            good = int(jnp.sum(self.successful))
            return f"Run of {self.steps.size} lanes {self.steps.shape}, {good} successful"
        cycles = self.impacts.shape[-1]
        lines = [f"Run of {cycles} cycles, {int(jnp.sum(self.impacts))} impacts"]
        last = ", ".join(
            f"{name} = {float(value[-1]):.9g}" for name, value in by_name(self.sections).items()
        )
        lines.append(f"  last section: {last}")
        if self.y_min is not None and self.y_max is not None:
            lines.append(f"  last cycle: Y in [{self.y_min[-1]:.6g}, {self.y_max[-1]:.6g}]")
        if self.errors is not None:
            worst = max(float(jnp.max(x)) for x in jtu.tree_leaves(self.errors.sections))
            lines.append(f"  error of the sections, estimated: {worst:.2g}")
        lines.append(f"  steps: {int(self.steps)} tried, {int(self.rejected)} rejected")
        ended = "completed" if bool(self.successful) else RESULTS[self.result]
        return "\n".join([*lines, f"  ended: {ended}"])
