"""`find_torus`: quasi-periodic motions as invariant curves of the section map."""

import dataclasses
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._checks import count, given_number, instance_of
from .._messages import count_of
from .._programs import compiled
from .._types import State
from ..flow import (
    RESULTS,
    AbstractMethod,
    EventKind,
    FixedStep,
    MethodLike,
    Run,
    chosen,
    simulate,
    sizes_on_host,
)
from ..machine import (
    AbstractMachine,
    angles_in,
    events_of,
    in_rows,
    is_autonomous,
    leaf,
    modes_of,
    raveled,
    renews,
    section_in,
    with_leaf,
    with_modes,
    without_modes,
    without_turns,
)
from .flight import Event, section_of
from .birkhoff import agreement, rotation_number, weights, without_angles
from .corrector import on_host
from .cycle_map import cycle_map, map_state
from .equations import ROUNDING, Observed, Shooting
from .from_orbit import equations_along, event_numbers, fixed_step_method, steps_of, with_sizes
from .results import Orbit
from .special import Point
from .torus_equations import (
    Condition,
    Curve,
    Equations,
    Solved,
    in_lanes,
    interpolated,
    modes,
)

# A torus is resolved if tail and residual are below the first number; nodes are doubled until the
# tail is below the second. The tail falls by some digits with each doubling. Choices.
RESOLVED, SETTLED = 1e-8, 1e-11

# The first and the largest number of nodes.
_FIRST, MOST = 33, 513

# Averages that agree to fewer digits are not those of a quasi-periodic motion. Those of 35 tori of
# an oscillator with a stop agreed to 5.3 and more over 2,048 cycles, those of chaos to 2.
_DIGITS = 4.5

# A motion repeats if sections so many cycles apart differ by less than this share: a choice.
_REPEATS, _LONGEST = 1e-8, 512

# The curve through a run is near its sections, relative to their sizes: a choice.
_NEAR = 0.1

# Events of a cycle that are listed: a choice.
_LISTED = 16

# A curve whose first mode is smaller than this share of its state is a fixed point: a choice, far
# above the corrector's tolerance. With it any ρ would solve the equations.
POINT = 1e-7

# Steps of the exponents' averages, and those before. Two exponents are equal if they differ by less
# than this multiple of the difference between both halves of the steps. Choices.
_STEPS, _SKIPPED, _PAIR = 16384, 512, 10.0

# Places around the least margin, and the number of times that the search closes in on it.
_PLACES, _CLOSER = 16, 3


@dataclasses.dataclass(frozen=True, repr=False, eq=False)
class Torus:
    """A quasi-periodic motion: a closed curve that the section map turns in itself, from
    `find_torus`; check `successful` before you use it. Numbers are in the machine's units.

    The curve is u(θ), with θ in turns from 0 to 1; a motion that begins at u(θ) is at u(θ + ρ)
    after `cycles` cycles.
    """

    problem: Shooting
    """The equations of the motion from event to event."""
    curve: Curve
    """The solution at the nodes θ = j/N."""
    size: float
    """Largest component of Newton's last correction, relative to the size of each unknown."""
    iterations: int
    """Number of corrections."""
    like: State
    """A state on the section, with the machine's own modes."""

    @property
    def machine(self) -> AbstractMachine:
        return self.problem.machine

    @property
    def method(self) -> AbstractMethod:
        return self.problem.method

    @property
    def cycles(self) -> int:
        """The cycles after which a motion is on the same closed curve again."""
        return self.problem.cycles

    @property
    def nodes(self) -> int:
        """Number N of nodes, odd."""
        return len(self.curve.x)

    @property
    def rotation(self) -> float:
        """Rotation number ρ: turns along the curve in `cycles` cycles, modulo 1."""
        return self.curve.rotation

    @cached_property
    def equations(self) -> Equations:
        return Equations(self.problem)

    @cached_property
    def states(self) -> State:
        """States on the section at the nodes; a pytree like a start, leaves (nodes,)."""
        return self.at(np.arange(self.nodes) / self.nodes)

    def at(self, angle: Any) -> State:
        """Return the states on the section at angles θ, in turns; leaves have their shape."""
        angle = np.asarray(angle, float)
        rows = self.equations.on_section(self.curve, np.mod(angle.ravel(), 1.0))
        states = jax.vmap(self.problem.unravel)(jnp.asarray(rows))
        return jax.tree.map(lambda a: np.asarray(a).reshape(angle.shape + a.shape[1:]), states)

    @cached_property
    def tail(self) -> float:
        """The largest of the highest fifth of the Fourier modes, relative to the largest mode."""
        return self.equations.tail(self.curve)

    @cached_property
    def residual(self) -> float:
        """Largest component of P(u(θ)) - u(θ + ρ) halfway between the nodes, relative to the size
        of each. P is a simulation, which detects its events: a touch between two nodes counts."""
        angles = (np.arange(self.nodes) + 0.5) / self.nodes
        begin, wanted = (
            self.equations.on_section(self.curve, angles + turn) for turn in (0.0, self.rotation)
        )
        last = follow(self.machine, self.method, self.like, self.cycles, begin).last
        sizes = np.asarray(self.problem.sizes)[1:]
        difference = _without_turns(self.problem, last - wanted) / sizes
        return float(np.abs(difference).max()) if np.isfinite(difference).all() else np.inf

    @cached_property
    def margins(self) -> "Margins":
        """The least distances from other events."""
        return margins_of(self.equations, self.curve)

    @property
    def clearance(self) -> float:
        """Smallest distance to a stop at a turn that does not touch it; infinite without such a
        turn, negative if the motion would pass through the stop."""
        return float(self.margins.values[0])

    @property
    def slowest_impact(self) -> float:
        """Smallest V⁻; infinite without impacts."""
        speeds = self.margins.values[4:][list(self.problem.impacts)]
        return float(speeds.min(initial=np.inf))

    @cached_property
    def exponents(self) -> np.ndarray:
        """Lyapunov exponents per cycle, the greatest first, from the derivatives at the nodes; that
        along the curve is 0. One fewer than states if an event ends the machine's cycles."""
        sizes = np.asarray(self.problem.sizes)[1:]
        jacobians, along = self.equations.cocycle(self.curve)
        jacobians, along = jacobians * sizes / sizes[:, None], along / sizes
        angles = np.mod(np.arange(_SKIPPED + _STEPS + 1) * self.rotation, 1.0)
        matrices = interpolated(jacobians.reshape(self.nodes, -1), angles[:-1])
        matrices = matrices.reshape(-1, *jacobians.shape[1:])
        along = interpolated(along, angles)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        number = len(sizes) - 1 - self.problem.autonomous
        rates = np.asarray(_growth(jnp.asarray(matrices), jnp.asarray(along), number))[_SKIPPED:]
        halves = [
            weights(len(part)) @ part for part in (rates[: _STEPS // 2], rates[_STEPS // 2 :])
        ]
        error = np.abs(np.subtract(*halves))
        found = weights(_STEPS) @ rates
        # A pair that turns in its plane has one exponent, but the averages of each of the two
        # converge slowly: only their sum does not depend on the directions.
        for k in range(number - 1):
            if found[k] - found[k + 1] < _PAIR * max(error[k : k + 2]):
                found[k : k + 2] = found[k : k + 2].mean()
        return np.sort(np.append(found, 0.0))[::-1] / self.cycles

    @cached_property
    def reason(self) -> str:
        """The reason why this is not a quasi-periodic motion of the machine; "" if it is one."""
        crossed = self.margins.crossed
        if np.abs(first_mode(self.equations, self.curve)).max() < POINT:
            return "The curve has shrunk to a periodic motion, which any rotation number solves."
        if self.tail > RESOLVED:
            return (
                f"The curve is not resolved by {self.nodes} nodes: its highest modes are "
                f"{self.tail:.1g} of the largest. Use more `nodes`."
            )
        if crossed is not None:
            words = self.margins.in_words(self.problem, crossed)
            return f"The motion has other events than the equations: {words}."
        if not self.residual < RESOLVED:
            return (
                f"Simulations leave the curve between its nodes, by {self.residual:.1g}. Use more "
                "`nodes`, or a finer `method`."
            )
        return ""

    @property
    def successful(self) -> bool:
        """True if tail, residual between the nodes and margins are those of a motion."""
        return not self.reason

    def __repr__(self) -> str:
        lines = [
            f"Torus with rotation number {self.rotation:.12g}, {count_of(self.nodes, 'node')}, "
            f"{'found' if self.successful else 'not found'}",
            f"  exponents per cycle: {', '.join(f'{x:.9g}' for x in self.exponents)}",
            f"  clearance {self.clearance:.4g}, slowest impact {self.slowest_impact:.4g}",
            f"  highest modes {self.tail:.1g}, residual between the nodes {self.residual:.1g}",
        ]
        return "\n".join([*lines, f"  note: {self.reason}"] if self.reason else lines)


@compiled
def _growth(matrices, along, number: int):
    """Return the logarithms of the growth of `number` directions in each step, across the unit
    vectors `along` the curve."""

    def across(frame, direction):
        return frame - jnp.outer(direction, direction @ frame)

    def step(frame, inputs):
        matrix, direction = inputs
        frame, lengths = jnp.linalg.qr(across(matrix @ frame, direction))
        return frame, jnp.log(jnp.abs(jnp.diag(lengths)))

    drawn = np.random.default_rng(0).normal(size=(matrices.shape[-1], number))
    frame = jnp.linalg.qr(across(jnp.asarray(drawn), along[0]))[0]
    return jax.lax.scan(step, frame, (matrices, along[1:]))[1]


class Margins(NamedTuple):
    """Least distances of the motions on a curve from other events, each over all angles."""

    values: np.ndarray
    """The least clearance, time between two events, agreement of modes and time from the section,
    then the least speed of approach of each event."""
    units: np.ndarray
    """The sizes of these along the motion."""
    angles: np.ndarray
    """The angle of each, in turns."""

    @property
    def crossed(self) -> int | None:
        """The number of the most negative margin; `None` if none is negative beyond rounding."""
        shares = np.nan_to_num(self.values / self.units, posinf=1.0, nan=-1.0)
        lowest = int(np.argmin(shares))
        return lowest if shares[lowest] < -ROUNDING else None

    def in_words(self, problem: Shooting, number: int) -> str:
        named = ["it touches a stop or a guard", "two events change their order"]
        named += ["a switch goes into another mode", "an event passes the section"]
        named += [f"the {event.name_on(problem.machine)} is missed" for event in problem.events]
        return f"{named[number]} at θ = {self.angles[number] % 1:.6g}"


def _columns(problem: Shooting, x: np.ndarray, observed: Observed) -> tuple[np.ndarray, np.ndarray]:
    """Return the margins of motions and their units, (angles, margins)."""
    count, ones = len(problem.events), np.ones(len(x))
    section = np.full(len(x), np.inf)
    if count and not problem.autonomous and problem.events[0].cycle != 0:
        section = np.minimum(x[:, 0], float(problem.period(x[0])) - x[:, count - 1])
    nearest, radian = observed.nearest, problem.radian * ones
    values = [nearest.margin, observed.order_margin, observed.modes_agree, section]
    units = np.column_stack([nearest.unit, radian, ones, radian, observed.units])
    return np.column_stack([*values, observed.approach]), units


def margins_of(equations: Equations, curve: Curve) -> Margins:
    """Return the margins; a search between the nodes closes in on the least of each."""
    problem = equations.motion(curve.p)
    values, units = _columns(problem, curve.x, equations.observe(curve))
    index = np.argmin(values, axis=0)
    centre, width = index / len(values), 1.0 / len(values)
    each = np.arange(values.shape[1])
    for _ in range(_CLOSER):
        angles = centre[:, None] + width * np.linspace(-1, 1, _PLACES)
        flat = angles.ravel()
        found = _columns(problem, interpolated(curve.x, flat), equations.observe(curve, flat))
        values, units = (a.reshape(len(each), _PLACES, -1)[each, :, each] for a in found)
        index = np.clip(np.argmin(values, axis=1), 1, _PLACES - 2)
        centre, width = angles[each, index], 2.0 * width / (_PLACES - 1)
    # The vertex of the parabola through the least three values.
    low, middle, high = (values[each, index + i] for i in (-1, 0, 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = (high - low) ** 2 / (8 * (high - 2 * middle + low))
    is_vertex = np.isfinite(depth) & (middle <= low) & (middle <= high)
    least = np.where(is_vertex, middle - np.where(is_vertex, depth, 0.0), values.min(axis=1))
    return Margins(least, units[each, index], centre)


def first_mode(equations: Equations, curve: Curve) -> np.ndarray:
    """Return the first Fourier mode of a curve, in scaled unknowns."""
    return np.fft.fft(equations.scaled(curve.x), axis=0)[1] / len(curve.x)


def _without_turns(problem: Shooting, difference: np.ndarray) -> np.ndarray:
    angles = angles_in(problem.machine, problem.like)
    return difference if angles is None else np.where(angles, without_turns(difference), difference)


class Followed(NamedTuple):
    """Motions of a period, by simulation; each field with the lanes first."""

    last: Any
    """States on the section at its end."""
    kind: Any
    """Kind, number and clock of each event of each cycle, as in `EventLog`."""
    number: Any
    phase: Any
    duration: Any
    """Duration of each cycle by the clock."""


@on_host
def _simulate(machine: AbstractMachine, method: AbstractMethod, like: State, cycles: int, rows):
    def follow(row):
        start = with_modes(raveled(like)[1](row), modes_of(like) or ())
        run = simulate(machine, start, cycles, method=method, event_log=_LISTED)
        log = run.event_log
        assert log is not None and run.duration is not None
        last = jnp.where(run.successful, raveled(run.last)[0], jnp.nan)
        return Followed(last, log.kind, log.number, log.phase, run.duration)

    return jax.vmap(follow)(rows)


def follow(
    machine: AbstractMachine, method: AbstractMethod, like: State, cycles: int, rows: np.ndarray
) -> Followed:
    """Simulate a period from states on the section, (lanes, states)."""
    program = lambda machine, rows: _simulate(machine, method, like, cycles, rows)
    return in_lanes(program, machine, rows)


def _start_equations(
    machine: AbstractMachine, method: AbstractMethod, like: State, cycles: int, rows: np.ndarray,
    rotation: float,
) -> tuple[Shooting, np.ndarray]:  # fmt: skip
    """Return the equations of the motions that begin in some states of a curve on the section, and
    their values of the unknowns, (nodes, unknowns)."""
    found = follow(machine, method, like, cycles, rows)
    _check_events(found)
    first = with_modes(raveled(like)[1](jnp.asarray(rows[0])), modes_of(like) or ())
    autonomous = is_autonomous(machine, without_modes(like))
    lengths = found.duration if autonomous else np.full_like(found.duration, float(machine.cycle))
    begins = np.concatenate([np.zeros((len(rows), 1)), np.cumsum(lengths, axis=1)], axis=1)
    placed = _placed(machine, without_modes(like), found, begins, cycles)
    order = [(float(clock[0]), event) for clock, event in placed]
    period = float(begins[0, -1])
    problem, _ = equations_along(machine, method, first, order, period, cycles, [machine])
    if not placed:
        return with_sizes(problem, rows[0], np.abs(rows).max(axis=0)), rows
    clocks = np.stack([clock for clock, _ in placed], axis=1)
    states, last = in_lanes(_fly_to_events, problem, clocks, begins[:, -1], rows)
    if problem.events[0].cycle == 0:  # its state is that before it
        states[:, 0] = last if len(rows) == 1 else interpolated(
            last, np.arange(len(rows)) / len(rows) - rotation
        )  # fmt: skip
    if autonomous:
        clocks[:, 0] = begins[:, -1]
    x = np.concatenate([clocks, states.reshape(len(rows), -1)], axis=1)
    largest = Equations(problem).observe(Curve(x, rotation, np.zeros(0))).largest
    return with_sizes(problem, x[0], largest.max(axis=0)), x


def _check_events(found: Followed) -> None:
    """Raise `ValueError` unless the same events happen in the same order from each node."""
    count = len(found.kind)
    if np.isin(found.kind, (EventKind.rest, EventKind.release)).any():
        raise ValueError(
            "Argument `start` must settle on a motion in flight, but it rests on a stop. Tori of "
            "motions that rest are not supported."
        )
    if (found.kind[..., -1] >= 0).any():
        raise ValueError(
            f"Argument `start` must settle on a motion with fewer than {_LISTED} events in a "
            "cycle, but it has more."
        )
    same = (found.kind == found.kind[0]) & (found.number == found.number[0])
    differs = np.flatnonzero(~same.reshape(count, -1).all(axis=1))
    if len(differs):
        raise ValueError(
            "Argument `start` must settle on a motion whose cycles all have the same events in the "
            f"same order, but those from θ = 0 and from θ = {differs[0] / count:.3g} differ: the "
            "curve grazes between them, or an event passes the section. In the second case shift "
            "the section."
        )


def _placed(
    machine: AbstractMachine, like: State, found: Followed, begins: np.ndarray, cycles: int
) -> list[tuple[np.ndarray, Event]]:
    """Return the events of a period in order, each with its clock from each node."""
    events, placed = events_of(machine), []
    numbers = event_numbers(machine, found.kind[0], found.number[0])
    for n, j in zip(*np.nonzero(found.kind[0] >= 0), strict=True):
        i = int(numbers[n, j])
        if events[i].ends_cycle:
            later = (n + 1) % cycles
            placed.append((begins[:, later], Event(i, later)))
        else:
            placed.append((begins[:, n] + found.phase[:, n, j], Event(i)))
    if section_in(machine, like) is not None or renews(machine):
        placed += [(begins[:, n], section_of(machine, n)) for n in range(cycles)]
    return sorted(placed, key=lambda p: (float(p[0][0]), p[1].cycle is not None))


@on_host
def _fly_to_events(problem: Shooting, clocks, period, rows):
    """Return the states just before each event and at the end of the period."""
    machine = problem.machine

    def fly(clock, period, u):
        s, states = jnp.zeros_like(period), []
        for i, event in enumerate(problem.events):
            if event.cycle == 0:
                states.append(u)
                continue
            u = problem.flight(machine, i - 1).fly(s, clock[i], u, problem.steps)[0]
            states.append(u)
            u, s = problem.after(machine, i, clock[i], u), clock[i]
        end = problem.flight(machine, problem.legs - 1).fly(s, period, u, problem.steps)[0]
        return jnp.stack(states), end

    return jax.vmap(fly)(clocks, period, rows)


def torus_of(solved: Solved, equations: Equations, like: State) -> Torus:
    motion = equations.motion(solved.curve.p)
    curve = solved.curve._replace(rotation=float(solved.curve.rotation), p=np.zeros(0))
    return Torus(motion, curve, solved.size, solved.iterations, like)


def _settled(
    equations: Equations, guess: Curve, nodes: int | None, most: int = MOST
) -> Solved | None:
    """Solve near a curve and double its nodes until the tail is small, unless `nodes` are given."""
    solved = equations.solve_near(guess)
    if solved is None or nodes is not None:
        return solved
    return equations.refined(solved, SETTLED, most)


def find_torus(
    machine: AbstractMachine,
    start: Any = None,
    *,
    cycles: int = 1,
    settle: int = 2000,
    observed: int = 2048,
    nodes: int | None = None,
    rotation: float | None = None,
    method: MethodLike = None,
) -> Torus:
    """Find the quasi-periodic motion on which a simulation settles, as an invariant curve.

    The curve u(θ) on the section solves P(u(θ)) = u(θ + ρ) at N nodes, with a trigonometric
    polynomial between them and the rotation number ρ as an unknown (Newton's method). The equations
    lead from event to event, as those of `continue_orbit`. The first guess are weighted averages
    over the sections of the run. Host-side: not to be traced.

    **Arguments:**

    - `machine`: a machine whose cycles end with its drive's, or at a section such as
      `vi.turn_of`.
    - `start`: a state on the section, by default the machine's own start; a `Run`, whose last state
      is used; or a Neimark–Sacker `Point` of a branch, as for `point.switch()`.
    - `cycles`: the number of cycles after which the motion is on the same closed curve again: 2 if
      the curve has two parts, which take turns.
    - `settle`, `observed`: numbers of periods before the averages, and of the averages.
    - `nodes`: number of nodes, odd. By default it is doubled from 33 until the highest modes are
      1e-11 of the largest, at most 513.
    - `rotation`: rotation number for the first guess, in turns per period, by default measured.
    - `method`: a method of fixed steps, by default `ExactFlight()` if it applies, else 48 steps of
      `Verner9` a cycle.

    **Returns:** a `Torus`; see `Torus.reason` if it is not `successful`.

    **Raises:** `ValueError` for a motion that is periodic, chaotic, rests on a stop, or has not the
    same events in each cycle, and if no curve is found.
    """
    if isinstance(start, Point):
        instance_of("start", found := start.switch(), Torus, "a Neimark–Sacker point")
        return found
    cycles, settle = count("cycles", cycles, least=1), count("settle", settle)
    observed = count("observed", observed, least=256)
    if nodes is not None and count("nodes", nodes, least=5) % 2 == 0:
        raise ValueError(f"Argument `nodes` must be odd, but is {nodes}.")
    if rotation is not None:
        rotation = given_number("rotation", rotation, low=0.0, high=1.0)
    the_map = cycle_map(machine, cycles, method=method)
    machine = the_map.machine
    method = torus_method(method, machine)
    if isinstance(start, Run):
        start = start.last
    like = map_state(machine, machine.start() if start is None else start, "start")
    if machine.position(without_modes(like)).dtype != jnp.float64:
        raise ValueError(
            "Argument `start` must be of double precision: call "
            '`jax.config.update("jax_enable_x64", True)` first.'
        )
    begin, rows = _observe_run(machine, method, like, cycles, settle, observed)
    rotation = _checked_rotation(machine, like, rows, cycles, rotation)
    number = _FIRST if nodes is None else nodes
    values, misses = _curve_through(rows, number, rotation)
    if misses > _NEAR:
        raise ValueError(
            "Argument `start` must settle on one closed curve on the section, but the curve with "
            f"rotation number {rotation:.6g} misses its sections by {misses:.2g} of their spread. "
            "Give the number of `cycles` after which it returns to the same curve, or `rotation`."
        )
    problem, x = _start_equations(machine, method, begin, cycles, values, rotation)
    equations = Equations(problem)
    solved = _settled(equations, Curve(x, rotation, np.zeros(0)), nodes)
    if solved is None:
        raise ValueError(
            f"No torus with a rotation number near {rotation:.6g} was found from this run. Observe "
            "more cycles (`settle`, `observed`), or give more `nodes`."
        )
    return torus_of(solved, equations, begin)


def torus_method(given: MethodLike, machine: AbstractMachine) -> AbstractMethod:
    # The default of `continue_orbit` has errors of some 1e-12, which would limit the residual.
    default = chosen(machine, None, FixedStep(steps_per_cycle=48))
    return fixed_step_method(given, default, machine)


def _observe_run(
    machine: AbstractMachine, method: AbstractMethod, like: State, cycles: int, settle: int,
    observed: int,
) -> tuple[State, np.ndarray]:  # fmt: skip
    """Return the last state of a run, and the states on the section after each period."""
    run = simulate(
        machine, like, cycles * observed, settle=cycles * settle, method=method, record="sections"
    )
    if not bool(run.successful):
        raise ValueError(
            "Argument `start` must begin a motion that can be simulated, but the run failed: "
            f"{RESULTS[run.result]}"
        )
    rows, angles = (
        np.asarray(in_rows(run.sections))[::cycles],
        angles_in(machine, without_modes(like)),
    )
    if angles is not None:
        rows = rows[0] + np.where(angles, without_turns(rows - rows[0]), rows - rows[0])
    return run.last, rows


def _checked_rotation(
    machine: AbstractMachine, like: State, rows: np.ndarray, cycles: int, given: float | None
) -> float:
    """Return the rotation number of a run that is quasi-periodic, else raise `ValueError`."""
    angles = angles_in(machine, without_modes(like))
    sizes = sizes_on_host(machine, without_modes(like), rows)
    differences = (np.abs(rows[-1] - rows[-_LONGEST - 1 : -1]) / sizes).max(axis=1)[::-1]
    repeats = np.flatnonzero(differences < _REPEATS)
    if len(repeats):
        period = cycles * (int(repeats[0]) + 1)
        raise ValueError(
            "Argument `start` must settle on a quasi-periodic motion, but this one repeats after "
            f"{count_of(period, 'cycle')}: find and follow that orbit."
        )
    seen = without_angles(jnp.asarray(rows), angles)
    digits = float(agreement(seen))
    if digits < _DIGITS:
        raise ValueError(
            "Argument `start` must settle on a quasi-periodic motion, but averages over both "
            f"halves of the run agree to {digits:.2g} digits only. A slowly settling motion needs "
            "more `settle`; a chaotic one has no torus."
        )
    return float(rotation_number(seen)) if given is None else given


def _curve_through(rows: np.ndarray, nodes: int, rotation: float) -> tuple[np.ndarray, float]:
    """Return the states at the nodes of the curve through the sections of a run, and the distance
    of the sections from it, relative to their spread. Its modes are weighted averages."""
    number, instants = modes(nodes), np.arange(len(rows))
    waves = np.exp(-2j * np.pi * np.outer(number, instants * rotation % 1.0))
    coefficients = (waves * weights(len(rows))) @ rows
    values = np.fft.ifft(coefficients * nodes, axis=0).real
    missed = rows - np.real(waves.conj().T @ coefficients)
    return values, float((missed.std(axis=0) / np.maximum(rows.std(axis=0), 1e-300)).max())


def torus_near(orbit: Orbit, parameter: str, width: float, distance: float) -> Torus:
    """Return the torus near a Neimark–Sacker point whose first mode has the size `distance`, in
    scaled unknowns; the parameter is an unknown."""
    like = orbit.state
    rows = np.asarray(raveled(without_modes(like))[0])[None]
    machine, cycles = orbit.machine, int(orbit.cycles)
    motion, x = _start_equations(machine, torus_method(None, machine), like, cycles, rows, 0.0)
    problem = with_parameter(motion, parameter, (width,))
    equations = Equations(problem)
    start = Curve(x, 0.0, np.array([float(leaf(machine, parameter))]))
    held = equations.at_parameter(start, float(start.p[0]))
    fixed = equations.solve(start, [held], is_cycle=True)
    if fixed is None:
        raise ValueError("The motion of this Neimark–Sacker point could not be refined.")
    rotation, mode = equations.rotating_mode(fixed.curve)
    angles = np.arange(_FIRST) / _FIRST
    waves = np.exp(2j * np.pi * angles)[:, None]
    x = fixed.curve.x + 2 * distance * np.real(waves * mode) * equations.scale
    guess = Curve(x, rotation, fixed.curve.p)
    part = mode[equations.first]
    row = waves.conj() * part.conj() / (_FIRST * np.vdot(part, part).real)
    none = np.zeros(1)
    held = [Condition(row.imag, 0.0, none, 0.0), Condition(row.real, 0.0, none, distance)]
    solved = equations.solve(guess, held)
    solved = None if solved is None else equations.refined(solved, SETTLED, MOST)
    if solved is None:
        raise ValueError(
            f"No torus was found at distance {distance:g} from this Neimark–Sacker point. Try a "
            "shorter distance."
        )
    return torus_of(solved, equations, like)


def with_parameter(problem: Shooting, name: str, interval: tuple[float, ...]) -> Shooting:
    """Return the equations with a parameter among the unknowns, with steps enough for both ends of
    its interval; one number is the width of the scale only."""
    ends = interval if len(interval) == 2 else (float(leaf(problem.machine, name)),)
    corners = [with_leaf(problem.machine, name, end) for end in ends]
    steps = steps_of(problem.method, corners, problem.like, problem.cycles)
    width = 0.5 * (interval[1] - interval[0]) if len(interval) == 2 else interval[0]
    return dataclasses.replace(
        problem, parameters=(name,), steps=max(problem.steps, steps), widths=jnp.asarray([width])
    )
