"""Periodic motions as data: their stability, the results of searches, and distinct motions."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Complex, Float, Int

from .._checks import (
    array_module,
    by_numpy_if_known,
    concrete,
    from_host,
    given_number,
    on_host,
    short,
)
from .._messages import count_of
from .._types import State, xr
from ..flow import (
    AbstractMethod,
    NamedEnumeration,
    Run,
    batch_names,
    in_names,
    present,
    quantities_on,
    simulate,
    sizes_on_host,
    span_of_position,
    states,
    tidy,
)
from ..lanes import pin
from ..machine import (
    AbstractMachine,
    Reset,
    Summarized,
    angles_in,
    clock_word,
    cycles_in_words,
    first_few,
    in_rows,
    in_unit,
    is_autonomous,
    labels_in,
    nearest_images,
    others_of,
    state_in_words,
    stop_in_words,
    stops_of,
    units_of,
    with_units,
    without_history,
    without_modes,
)
from .tolerances import ROUNDING, ROUNDINGS


class STABILITY(NamedEnumeration):
    """The stability of a periodic motion, or the way in which it was lost."""

    stable = "stable"
    fold = "unstable: a real multiplier above 1 (past a fold or where branches cross)"
    period_doubling = "unstable: a real multiplier below -1 (past a period doubling)"
    neimark_sacker = "unstable: a complex pair outside the unit circle (past a Neimark–Sacker)"
    neutral = "neutral: neither stable nor unstable to rounding, a multiplier has modulus 1"
    unknown = "without multipliers"


def multipliers_of(monodromy: Float[Array, "*batch n n"]) -> Complex[Array, "*batch n"]:
    """Return the eigenvalues of monodromy matrices, the largest modulus first, or NaN. They are
    computed by NumPy if the matrices are known."""
    known = concrete(monodromy)
    if known is None:
        return jnp.vectorize(_multipliers, signature="(n,n)->(n)")(monodromy)
    finite = np.asarray(np.isfinite(known).all(axis=(-2, -1), keepdims=True))
    safe = np.where(finite, known, np.eye(known.shape[-1], dtype=known.dtype))
    if known.shape[-1] == 2:
        values = eigenvalues(*_half_trace_and_determinant(safe))
    else:
        values = np.linalg.eigvals(safe).astype(np.result_type(known.dtype, np.complex64))
    values = np.take_along_axis(values, np.argsort(-abs(values), axis=-1, kind="stable"), axis=-1)
    return from_host(np.where(finite[..., 0], values, np.nan))


def _multipliers(monodromy: Float[Array, "n n"]) -> Complex[Array, " n"]:
    finite = jnp.all(jnp.isfinite(monodromy))
    safe = jnp.where(finite, monodromy, jnp.eye(monodromy.shape[0], dtype=monodromy.dtype))
    if monodromy.shape == (2, 2):
        values = eigenvalues(*_half_trace_and_determinant(safe))
    else:
        values = jnp.linalg.eigvals(safe)
    order = jnp.argsort(-jnp.abs(values))
    return jnp.where(finite, values[order], jnp.nan)


def _half_trace_and_determinant(matrix: Any) -> tuple[Any, Any]:
    a, b, c, d = (matrix[..., i, j] for i in range(2) for j in range(2))
    return 0.5 * (a + d), a * d - b * c


def eigenvalues(half: Any, determinant: Any) -> Any:
    """Return the eigenvalues of 2x2 matrices from half their trace and their determinant."""
    array = array_module(half)
    square = half * half - determinant
    # Pinned: computed again with other rounding, it might be zero in one use and not in another
    # (seen with JAX 0.12: 1 ± 0.7 for 1 and 1).
    square = square if array is np else pin(square)
    square = square.astype(array.result_type(half, array.complex64))
    double = square == 0  # the derivative of the root is infinite there
    root = array.where(double, 0.0, array.sqrt(array.where(double, 1.0, square)))
    return array.stack([half + root, half - root], axis=-1)


def stability_of(multipliers: Complex[Array | np.ndarray, "*batch n"]) -> STABILITY:
    array = array_module(multipliers)
    place = array.argmax(abs(multipliers), axis=-1, keepdims=True)
    largest = array.take_along_axis(multipliers, place, axis=-1)[..., 0]
    size = abs(largest)
    real = abs(largest.imag) <= ROUNDING * size
    unstable_kind = STABILITY.where(
        real & (largest.real > 0),
        STABILITY.fold,
        STABILITY.where(real, STABILITY.period_doubling, STABILITY.neimark_sacker),
    )
    verdict = STABILITY.where(size < 1, STABILITY.stable, unstable_kind)
    rounding = max(ROUNDING, 100 * float(jnp.finfo(size.dtype).eps))
    verdict = STABILITY.where(abs(size - 1) <= rounding, STABILITY.neutral, verdict)
    return STABILITY.where(array.isnan(size), STABILITY.unknown, verdict)


def compound(matrix: Float[Array, "n n"]) -> Float[Array, "pairs pairs"]:
    """Return the second compound matrix, of all determinants of two rows and two columns. Its
    eigenvalues are the products of two of the eigenvalues."""
    first, second = np.triu_indices(len(matrix), 1)
    rows, others = matrix[first], matrix[second]
    return rows[:, first] * others[:, second] - rows[:, second] * others[:, first]


class ORBIT_RESULTS(NamedEnumeration):
    """The end of a search for a periodic motion, one for each guess of `find_orbit`."""

    successful = ""
    smaller_period = "The motion found has a smaller period than was asked for; see `Orbit.cycles`."
    inadmissible = "The motion found would pass through a stop."
    no_orbit = (
        "The residual did not fall below the tolerance: no orbit was found from this guess; begin "
        "nearer to one, such as the end of a long simulation, or search with other `cycles`."
    )
    grazing = (
        "No orbit was found: the search ended beside a grazing, where the cycle map has no "
        "derivative."
    )
    drifts = (
        "No orbit was found: the motion drifts. A component of the state changes as much in each "
        "cycle (a multiplier is 1), as the place of a body that moves on. Set it back once a cycle "
        "by the machine's method `renewed`, count an angle by `vi.turn_of`, or leave it out."
    )
    equilibrium = (
        "No orbit was found: the search ended at an equilibrium, where nothing moves; it meets the "
        "equations of a motion with any period."
    )
    not_simulated = (
        "The guess cannot be simulated: it lies beyond a stop, say, or a number of the machine is "
        "not finite, or the motion ends with an outcome. Simulate from it to see the reason."
    )
    other_modes = (
        "No orbit was found: the motion comes back to its state in other modes of the machine. Its "
        "period is longer: ask for more `cycles`."
    )


class Orbit(Summarized):
    """A periodic motion, from `find_orbit`; check `result` before you use it.

    Under `vmap` every array has the batch axes in front, and the impact arrays are padded with NaN
    (stops: -1). Numbers are in the machine's units (see `AbstractMachine.units`): those of a
    `Scene` in a and ω.
    """

    machine: AbstractMachine
    """The machine, in the phase clock."""
    method: AbstractMethod
    state: State
    """State on the section, a pytree like a start; a `HybridState` with discrete modes."""
    sections: State
    """States on the sections of all cycles of the search; leaves (cycles,)."""
    cycles: Int[Array, "..."]
    """Least period in drive cycles."""
    duration: Float[Array, "..."]
    """Least period in time τ."""
    frequency_ratio: Float[Array, "..."] | None
    """ζ: mean speed of the drive over the period; `None` for machines without a drive."""
    impact_phase: Float[Array, "... impacts"]
    """Clock of each impact, rising from the section on, in the machine's units: the crank angle in
    radians for a `Scene`, the variable that counts the cycles for any other."""
    impact_speed: Float[Array, "... impacts"]
    """V⁻, speed of approach just before each impact, in the machine's unit (for a `Scene` a ω)."""
    impact_stop: Int[Array, "... impacts"]
    """Number of the rigid stop of each impact."""
    impacts: Int[Array, "..."]
    """Number of impacts in the period."""
    rests: Int[Array, "..."]
    """Number of times that a body comes to rest on a stop in the period; 0 if it always rests."""
    y_min: Float[Array, "..."]
    """Smallest position of the first coordinate in the period."""
    y_max: Float[Array, "..."]
    """Largest position of the first coordinate in the period."""
    clearance: Float[Array, "..."]
    """Smallest distance to a stop at a turn that does not touch it, along a branch of several stops
    the smallest as a share of the motion's size there; infinite without such a turn, negative if
    the motion would pass through the stop."""
    monodromy: Float[Array, "... states states"]
    """Derivative of the map over the period, in the order of the state's leaves, on the section of
    the search, which `find_orbit` chooses away from the impacts."""
    multipliers: Complex[Array, "... states"]
    """Floquet multipliers over the period, the largest modulus first."""
    residual: Float[Array, "..."]
    """Largest component of P(x) - x, the difference of the state after one period, relative to the
    size of each component (1 for a `Scene`)."""
    error: Float[Array, "..."]
    """Estimated error of `state`, likewise relative: largest component of Newton's next step."""
    iterations: Int[Array, "..."]
    """Number of steps of the search."""
    history: Float[Array, "... max_steps"]
    """Residual after each step of the search, NaN beyond the last."""
    result: ORBIT_RESULTS
    """Success, or the reason why no orbit was found."""
    averages: dict[str, Float[Array, "..."]] = eqx.field(default_factory=dict)
    """The machine's own averages over the time of the period, by name (see
    `AbstractMachine.averages`)."""
    modes: tuple[Float[Array, "... cycles"], ...] = ()
    """The machine's own modes on the sections (see `AbstractMachine.modes`)."""
    delay_error: Float[Array, ""] | None = None
    """Of a machine with delays: the difference of the state from that of a run with the whole
    history, which a stable motion settles on, relative to the size of each component; or that of
    the duration or of the largest impact speed, relative to it, if it is larger."""

    @property
    @by_numpy_if_known
    def successful(self) -> Any:
        """True if an orbit was found, of the given period or a smaller one."""
        return (self.result == ORBIT_RESULTS.successful) | (
            self.result == ORBIT_RESULTS.smaller_period
        )

    @property
    @by_numpy_if_known
    def stable(self) -> Any:
        """True if all multipliers lie inside the unit circle, by more than rounding; false also if
        they are not known (see `stability`)."""
        return self.stability == STABILITY.stable

    @property
    @by_numpy_if_known
    def stability(self) -> STABILITY:
        """Stable, neutral, or how stability was lost: fold, period doubling or Neimark–Sacker."""
        verdict = stability_of(self.multipliers)
        return STABILITY.where(self.successful, verdict, STABILITY.unknown)

    @property
    def quantities(self) -> dict[str, Float[Array, "... cycles"]]:
        """The machine's own functions of its state on the sections, by name (see
        `AbstractMachine.quantities`)."""
        return quantities_on(self.machine, self.sections, self.residual.ndim)

    @property
    @by_numpy_if_known
    def slowest_impact(self) -> Any:
        """Smallest V⁻, the distance to a grazing at which an impact is lost; infinite without
        impacts. The distance to other grazings is `clearance`."""
        array = array_module(self.impact_speed)
        speed = array.where(array.isnan(self.impact_speed), jnp.inf, self.impact_speed)
        return array.min(speed, axis=-1, initial=jnp.inf)

    @property
    @by_numpy_if_known
    def admissible(self) -> Any:
        """True if the motion stays inside the gap and every impact approaches its stop."""
        slack = 1e4 * jnp.finfo(self.y_max.dtype).eps
        size = array_module(self.y_max).maximum(abs(self.y_min), abs(self.y_max))
        inside = self.clearance >= 0
        for stop in stops_of(self.machine):
            if stop.coordinate:
                continue  # the extrema are those of the first coordinate
            reach = self.y_max if stop.sign > 0 else -self.y_min
            inside = inside & (reach <= stop.gap + slack * (size + jnp.abs(stop.gap)))
        return self.successful & inside & (self.slowest_impact > 0)

    def trajectory(
        self, *, cycles: int | None = None, samples: int = 128, impact_log: int = 8,
        event_log: int = 0,
    ) -> Run:  # fmt: skip
        """Return the motion over one period (or `cycles` drive cycles), sampled, for plots. The
        arguments are those of `simulate`.

        **Raises:** `ValueError` for a batch of orbits, or a guess that led to none.
        """
        if self.residual.ndim:
            raise ValueError(
                f"`trajectory` needs one orbit, but this is a batch of shape {self.residual.shape}."
            )
        machine = self.machine
        if not bool(self.successful):
            raise ValueError(
                "`trajectory` needs an orbit, but the search for this one failed. Its `result` is "
                "the reason."
            )
        if cycles is None:
            cycles = int(self.cycles)
        if is_autonomous(machine, self.state):
            # Its cycles may differ in length: an interval is a period, or the whole motion.
            period = int(self.cycles)
            each = period if cycles % period == 0 else cycles
            machine = machine.observed_every(np.asarray(self.duration) * (each / period))
            samples, impact_log, event_log = (each * n for n in (samples, impact_log, event_log))
            cycles //= each
        return simulate(
            machine, self.state, cycles, method=self.method, samples=samples,
            impact_log=impact_log, event_log=event_log,
        )  # fmt: skip

    def to_xarray(
        self, dims: Sequence[str] | None = None, *, along: str | None = None
    ) -> "xr.Dataset":
        """Return this orbit, or a batch of them, as an `xarray.Dataset`.

        Each component of the section states is a variable (`section_Y`), multipliers are complex;
        `result` and `stability` are words. `dims` and `along` are as in `Run.to_xarray`; `along` is
        `"section"`, `"impact"`, `"multiplier"`, `"column"` of the monodromy matrix, or a batch
        axis.
        """
        batch = batch_names(dims, self.residual.ndim)
        scalars = ("cycles", "duration", "frequency_ratio", "impacts", "rests", "y_min", "y_max",
                   "clearance", "residual", "error", "iterations")  # fmt: skip
        per_impact = ("impact_phase", "impact_speed", "impact_stop")
        variables = states("section", self.sections, (*batch, "section"))
        variables |= states("section", self.quantities, (*batch, "section"))
        modes = {f"mode_{i}": x for i, x in enumerate(self.modes)}
        variables |= states("section", modes, (*batch, "section"))
        variables |= present({name: getattr(self, name) for name in scalars} | self.averages, batch)
        variables |= present({name: getattr(self, name) for name in per_impact}, (*batch, "impact"))
        variables |= present({"multipliers": self.multipliers}, (*batch, "multiplier"))
        variables |= present({"monodromy": self.monodromy}, (*batch, "row", "column"))
        words = {"result": in_names(self.result), "stability": in_names(self.stability)}
        data = xr.Dataset(variables | present(words, batch))
        quantities = {name: name for name in self.averages}
        return tidy(with_units(data, units_of(self.machine), quantities), along)

    def summary(self) -> str:
        """Describe the motion, its impacts and its multipliers."""
        if self.residual.ndim:
            found = self.successful
            counted = f"{int(np.sum(self.stable))} of them stable"
            if np.any(found & (self.stability == STABILITY.unknown)):
                counted = STABILITY[STABILITY.unknown]
            searches = f"{self.residual.size} searches {self.residual.shape}"
            return f"{searches}: {int(np.sum(found))} orbits found, {counted}"
        if not bool(self.successful):
            reason = ORBIT_RESULTS[self.result]
            return f"No orbit: {reason} Residual {float(self.residual):.3g}.{_advice(self)}"
        count, cycles, units = int(self.impacts), int(self.cycles), units_of(self.machine)
        period = cycles_in_words(self.machine, cycles)
        own = without_history(self.machine, without_modes(self.state))
        lines = [
            f"Orbit of period {period} with {hits_in_words(self)}, {STABILITY[self.stability]}",
            f"  section: {state_in_words(own, 9, units)}",
            f"  {span_in_words(self, 9)}",
        ]
        if is_autonomous(self.machine, self.state):
            lines.append(f"  duration: {in_unit(f'{float(self.duration):.9g}', units, 'time')}")
        impacts = zip(self.impact_phase, self.impact_speed, self.impact_stop, strict=True)
        for phase, speed, stop in impacts:
            if stop >= 0:
                name = stop_in_words(self.machine, stops_of(self.machine)[int(stop)])
                fast = in_unit(f"{float(speed):.9g}", units, "velocity")
                clock = in_unit(f"{clock_word(self.machine)} {float(phase):.6f}", units, "phase")
                lines.append(f"  impact: {name} at {clock}, V⁻ = {fast}")
        for name, x in self.averages.items():
            lines.append(f"  mean {name}: {in_unit(f'{float(x):.9g}', units, name)}")
        listed = int(np.sum(self.impact_stop >= 0))
        if listed < count:
            lines.append(f"  only {listed} of {count} impacts: find it with `impact_log={count}`")
        if self.stability != STABILITY.unknown:
            values = multipliers_in_words(self.multipliers, 7, 1e-12)
            lines.append(f"  multipliers: {', '.join(first_few(values))}")
        if np.isfinite(float(self.clearance)):
            room = in_unit(f"{float(self.clearance):.4g}", units, "position")
            lines.append(f"  clearance: {room}")
        lines.append(
            f"  search: residual {float(self.residual):.2g} after {int(self.iterations)} steps, "
            f"{float(self.error):.2g} from its solution; the method's error comes on top"
        )
        if self.delay_error is not None:
            lines.append(
                f"  history at nodes: a run with the whole history differs by "
                f"{float(self.delay_error):.2g}"
                f"{'' if bool(self.stable) else ', since it departs from an unstable motion'}"
            )
        reason = ORBIT_RESULTS[self.result]
        return "\n".join([*lines, f"  note: {reason}"] if reason else lines)


def check_multipliers(name: str, orbit: Orbit) -> None:
    """Raise `ValueError` if a motion, or one of a batch, was found without multipliers."""
    if bool(jnp.any(orbit.successful & jnp.isnan(orbit.multipliers).any(axis=-1))):
        raise ValueError(
            f"Argument `{name}` must have multipliers, but they are not a number: find it without "
            "`multipliers=False`."
        )


_ADVICE_ON_RESETS = (
    " Events that a reset sets off at the same instant change the number of cycles (see the event "
    "log)."
)


def _advice(orbit: Orbit) -> str:
    if orbit.result != ORBIT_RESULTS.no_orbit:
        return ""
    # A choice: searches from bad starts end with residuals of some 1e-3 and more.
    if not float(orbit.residual) < 1e-7:
        return _ADVICE_ON_RESETS * any(isinstance(x, Reset) for x in others_of(orbit.machine))
    return (
        " So small a residual is mostly the steps' own error: ask for a finer `method`, or for less"
        " by `root_finder=vi.Newton(tolerance=1e-8)`."
    )


def lies_on_a_stop(orbit: Orbit) -> bool:
    x, machine = without_modes(orbit.state), orbit.machine
    stops = map(on_host, stops_of(machine))
    bodies = ((stop, machine.coordinates[stop.coordinate]) for stop in stops)
    return any(stop.beyond(y.position(x)) >= 0 and y.velocity(x) == 0 for stop, y in bodies)


def hits_in_words(orbit: Orbit) -> str:
    words, rests = count_of(int(orbit.impacts), "impact"), int(orbit.rests)
    if rests:
        return f"{words} and {count_of(rests, 'rest')} on a stop"
    return f"{words} and rest on a stop" if lies_on_a_stop(orbit) else words


def span_in_words(orbit: Orbit, digits: int) -> str:
    """Return the interval of the first coordinate, with its name in pictures."""
    machine, ends = orbit.machine, (orbit.y_min, orbit.y_max)
    labels = labels_in(machine, without_modes(orbit.state))
    return span_of_position(labels, units_of(machine), ends, digits)


def multipliers_in_words(multipliers: Any, digits: int, rounding: float) -> list[str]:
    """Format multipliers: as real numbers if the imaginary part is below `rounding`, relative to
    the modulus, and as 0 below the rounding of their matrix."""
    values = np.asarray(multipliers)
    zero = ROUNDINGS * np.finfo(values.dtype).eps * max(1.0, np.abs(values).max(initial=0.0))

    def word(z: complex) -> str:
        if abs(z) < zero:
            return "0"
        imaginary = f"{z.imag:+.{digits}g}i" if abs(z.imag) > rounding * abs(z) else ""
        return f"{z.real:.{digits}g}{imaginary}"

    return [word(z) for z in values]


def trimmed(orbit: Orbit) -> Orbit:
    """Remove the padding of the impacts of one orbit; return traced or batched orbits unchanged."""
    if isinstance(orbit.residual, Tracer) or orbit.residual.ndim:
        return orbit
    per_impact = ("impact_phase", "impact_speed", "impact_stop")
    cut = {name: _first(getattr(orbit, name), int(orbit.impacts)) for name in per_impact}
    cycles, kept = int(orbit.cycles), (orbit.sections, orbit.modes)
    sections, modes = jtu.tree_map(lambda x: _first(x, cycles), kept)
    return dataclasses.replace(orbit, **cut, sections=sections, modes=modes)


def _first(x: Array, number: int) -> Array:
    return from_host(on_host(x)[:number])


def distance(here: Any, there: Any, unit: Any = 1) -> Any:
    """Return the distance of states from others, relative to `unit` + |state| of the latter.

    It is the largest over the components, the last axis. Everywhere in the package it decides
    whether two states, or two motions, are the same; `unit` are their `row_sizes`.
    """
    return (abs(here - there) / (unit + abs(there))).max(axis=-1)


class MotionSections(NamedTuple):
    """The sections of a periodic motion, and what its distance from another is measured by."""

    states: Float[np.ndarray, "cycles states"]
    modes: Float[np.ndarray, "cycles modes"]
    """The machine's own modes there."""
    sizes: Any
    """The `row_sizes` of the states."""
    angles: np.ndarray | None

    def near(self, states: np.ndarray, references: np.ndarray) -> np.ndarray:
        """Move states by whole turns of their angles to where they are nearest to others."""
        return nearest_images(self.angles, states, references)

    def between(self, states: np.ndarray, references: np.ndarray) -> Any:
        """Return the distance of states from others, up to whole turns."""
        return distance(self.near(states, references), references, self.sizes)

    def distance(self, states: np.ndarray) -> Any:
        """Return the distance of states from the nearest section."""
        return self.between(states[..., None, :], self.states).min(axis=-1)

    def passes(self, state: np.ndarray, modes: np.ndarray, tolerance: float) -> bool:
        """Return whether it passes through a state in these modes, on any section: then the motion
        from there is the same one."""
        near = self.between(self.states, state) <= tolerance
        return bool((near & (self.modes == modes).all(axis=-1)).any())


def index_of(
    motions: Sequence[MotionSections], cycles: int, state: np.ndarray, modes: np.ndarray,
    tolerance: float,
) -> int:  # fmt: skip
    """Return the index among known motions of that with a period of `cycles` through a state in
    these modes; their number if it is a new one."""
    known = (
        i
        for i, motion in enumerate(motions)
        if len(motion.states) == cycles and motion.passes(state, modes, tolerance)
    )
    return next(known, len(motions))


class Orbits(list[Orbit]):
    """Several periodic motions: a list that prints as a table, one motion a line."""

    def __repr__(self) -> str:
        return "\n".join([count_of(len(self), "orbit"), *map(in_one_line, self)])


def in_one_line(orbit: Orbit) -> str:
    cycles = int(orbit.cycles)
    period = cycles_in_words(orbit.machine, cycles)
    stable = STABILITY[orbit.stability].partition(":")[0]
    place = state_in_words(without_modes(orbit.state), 6, units_of(orbit.machine))
    size = f"; greatest multiplier {np.abs(orbit.multipliers).max():.6g}"
    size = "" if orbit.stability == STABILITY.unknown else size
    found = f"  {period}, {hits_in_words(orbit)}, {stable}: {place}; {span_in_words(orbit, 6)}"
    return found + size


def distinct_orbits(orbits: Orbit, *, tolerance: float = 1e-6) -> tuple[Orbits, np.ndarray]:
    """Return the different motions among many searches.

    Motions that differ only by the cycle on which they are observed count as one, and a motion
    found with a multiple of its period counts with its least period. Failed searches are left out.
    Host-side: not to be traced.

    **Arguments:** a batch of orbits from `find_orbit` (of any shape); two motions are the same if
    their sections agree to `tolerance`, relative to the size of each component of the state, and
    the machine's modes there are equal.

    **Returns:** the orbits, a list that prints one motion a line, by period and then by least Y,
    each on the section on which it was first found; and the number of searches that found each.
    """
    if not isinstance(orbits, Orbit):
        raise TypeError(f"Argument `orbits` must be from `find_orbit`, but got {short(orbits)}.")
    given_number("tolerance", tolerance, low=0.0)
    found, counts = distinct_among([orbits], tolerance)
    return found, counts[:, 0]


def distinct_among(batches: Sequence[Orbit], tolerance: float) -> tuple[Orbits, np.ndarray]:
    """Return the different motions in several batches of searches, possibly for different periods,
    and the number of searches of each batch that found each, (motions, batches)."""
    chosen: list[Orbit] = []
    motions: list[MotionSections] = []
    counts: list[np.ndarray] = []
    for batch, orbits in enumerate(batches):
        shape = orbits.residual.shape

        def in_one_row(x: object, shape: tuple[int, ...] = shape) -> np.ndarray:
            x = np.asarray(x)
            return x.reshape(-1, *x.shape[len(shape) :])

        found = in_one_row(orbits.successful)
        flat = jtu.tree_map(in_one_row, orbits)
        sections, cycles = in_rows(on_host(flat.sections), 2), flat.cycles
        modes = np.zeros((*sections.shape[:2], 0))
        modes = np.stack(flat.modes, axis=-1) if flat.modes else modes
        angles = angles_in(orbits.machine, jtu.tree_map(lambda x: x[0, 0], flat.sections))
        for i in np.flatnonzero(found):
            path = sections[i, : cycles[i]]
            j = index_of(motions, len(path), path[0], modes[i, 0], tolerance)
            if j == len(motions):
                chosen.append(trimmed(jtu.tree_map(lambda x, i=i: jnp.asarray(x[i]), flat)))
                sizes = sizes_on_host(chosen[j].machine, chosen[j].state, path)
                motions.append(MotionSections(path, modes[i, : cycles[i]], sizes, angles))
                counts.append(np.zeros(len(batches), int))
            counts[j][batch] += 1
    order = sorted(
        range(len(chosen)), key=lambda j: (int(chosen[j].cycles), float(chosen[j].y_min))
    )
    table = np.array([counts[j] for j in order], int).reshape(len(order), len(batches))
    return Orbits(chosen[j] for j in order), table
