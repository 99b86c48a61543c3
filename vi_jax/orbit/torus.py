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
    in_rows,
    leaf,
    modes_of,
    nearest_images,
    raveled,
    with_leaf,
    with_modes,
    without_modes,
)
from .birkhoff import agreement, rotation_number, weights, without_angles
from .corrector import on_host
from .cycle_map import CycleMap, cycle_map, map_state
from .equations import ROUNDING, Observed, Shooting
from .from_orbit import (
    LISTED,
    begins_after_jump,
    equations_along,
    fixed_step_method,
    placed_events,
    steps_of,
    with_sections,
    with_sizes,
)
from .results import Orbit
from .special import Point
from .torus_equations import Curve, Equations, Solved, in_lanes, interpolated, modes

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

# A curve whose first mode is smaller than this share of its state is a fixed point: a choice, far
# above the corrector's tolerance. With it any ρ would solve the equations.
POINT = 1e-7

# Steps of the exponents' averages, and those before. Two exponents are equal if they differ by less
# than this multiple of the difference between both halves of the steps. Choices.
_STEPS, _SKIPPED, _PAIR = 16384, 512, 10.0

# Places around the least margin, and the number of times that the search closes in on it.
_PLACES, _CLOSER = 16, 5


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
        the_map = cycle_map(self.machine, self.cycles, method=self.method)
        end = in_lanes(_mapped, (the_map, self.like), begin)
        end = nearest_images(angles_in(self.machine, self.problem.like), end, wanted)
        difference = (end - wanted) / np.asarray(self.problem.sizes)[1:]
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
        if first_mode(self.equations, self.curve)[1] < POINT:
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
    shares: np.ndarray
    """These, relative to their sizes along the motion."""
    angles: np.ndarray
    """The angle of each, in turns."""

    @property
    def crossed(self) -> int | None:
        """The number of the most negative margin; `None` if none is negative beyond rounding."""
        lowest = int(np.argmin(self.shares))
        return lowest if not self.shares[lowest] >= -ROUNDING else None

    def in_words(self, problem: Shooting, number: int) -> str:
        named = ["it touches a stop or a guard", "two events change their order"]
        named += ["a switch goes into another mode", "an event passes the section"]
        named += [f"the {event.name_on(problem.machine)} is missed" for event in problem.events]
        return f"{named[number]} at θ = {self.angles[number] % 1:.4g}"


def _columns(problem: Shooting, x: np.ndarray, observed: Observed) -> tuple[np.ndarray, np.ndarray]:
    """Return the margins of motions, and relative to their sizes, (angles, margins)."""
    count, section = len(problem.events), np.full(len(x), np.inf)
    if count and not problem.autonomous and problem.events[0].cycle != 0:
        section = np.minimum(x[:, 0], float(problem.period(x[0])) - x[:, count - 1])
    nearest, ones = observed.nearest, np.ones(len(x))
    values = [nearest.margin, observed.order_margin, observed.modes_agree, section]
    units = [nearest.unit, problem.radian * ones, ones, problem.radian * ones]
    values = np.column_stack([*values, observed.approach])
    return values, values / np.column_stack([*units, observed.units])


def margins_of(equations: Equations, curve: Curve) -> Margins:
    """Return the margins; a search between the nodes closes in on the least of each."""
    problem = equations.motion(curve.p)
    values, shares = _columns(problem, curve.x, equations.observe(curve))
    centre, width = np.argmin(values, axis=0) / len(values), 1.0 / len(values)
    each = np.arange(values.shape[1])
    for _ in range(_CLOSER):
        angles = centre[:, None] + width * np.linspace(-1, 1, _PLACES)
        flat = angles.ravel()
        found = _columns(problem, interpolated(curve.x, flat), equations.observe(curve, flat))
        values, shares = (a.reshape(len(each), _PLACES, -1)[each, :, each] for a in found)
        index = np.clip(np.argmin(values, axis=1), 1, _PLACES - 2)
        centre, width = angles[each, index], 2.0 * width / (_PLACES - 1)
    return Margins(values.min(axis=1), shares.min(axis=1), centre)


def first_mode(equations: Equations, curve: Curve) -> tuple[np.ndarray, float]:
    """Return the first Fourier mode of a curve, in scaled unknowns, and its largest component."""
    mode = np.fft.fft(curve.x / equations.scale, axis=0)[1] / len(curve.x)
    return mode, float(np.abs(mode).max())


@on_host
def _mapped(map_and_state: tuple[CycleMap, State], rows):
    """Return the states on the section after the period of a map, from states on it."""
    the_map, like = map_and_state
    start = lambda row: with_modes(raveled(like)[1](row), modes_of(like) or ())
    return jax.vmap(lambda row: raveled(the_map(start(row)))[0])(rows)


def _start_equations(
    machine: AbstractMachine, method: AbstractMethod, like: State, cycles: int, rows: np.ndarray,
    rotation: float,
) -> tuple[Shooting, np.ndarray]:  # fmt: skip
    """Return the equations of the motions that begin in some states of a curve on the section, and
    their values of the unknowns, (nodes, unknowns)."""
    motions, plain = [], without_modes(like)
    for row in rows:
        start = with_modes(raveled(like)[1](jnp.asarray(row)), modes_of(like) or ())
        run = simulate(machine, start, cycles, method=method, event_log=LISTED + 1)
        assert run.event_log is not None
        if np.isin(run.event_log.kind, (EventKind.rest, EventKind.release)).any():
            raise ValueError(
                "Argument `start` must settle on a motion in flight, but it rests on a stop. Tori "
                "of motions that rest are not supported."
            )
        begins, found = placed_events(machine, run, "start")
        found, period = with_sections(machine, plain, begins, found, cycles), float(begins[-1])
        motions.append(equations_along(machine, method, start, found, period, cycles, [machine]))
    problem, x = (
        max((p for p, _ in motions), key=lambda p: p.steps),
        np.stack([x for _, x in motions]),
    )
    for i, (other, _) in enumerate(motions):
        if (other.events, other.modes) != (problem.events, problem.modes):
            raise ValueError(
                "Argument `start` must settle on a motion whose cycles all have the same events in "
                f"the same order, but those from θ = 0 and from θ = {i / len(rows):.3g} differ: "
                "the curve grazes between them, or an event passes the section. In the second case "
                "shift the section."
            )
    if problem.events and begins_after_jump(machine, problem.events[0]):
        # Its state is that before the jump, which ends the motion from θ - ρ.
        states = slice(problem.legs, problem.legs + problem.states)
        angles = np.arange(len(rows)) / len(rows)
        x[:, states] = interpolated(x[:, states], angles - rotation)
    largest = Equations(problem).observe(Curve(x, rotation, np.zeros(0))).largest
    return with_sizes(problem, x[0], largest.max(axis=0)), x


def torus_of(solved: Solved, equations: Equations, like: State) -> Torus:
    return Torus(equations.motion(solved.curve.p), solved.curve._replace(p=np.zeros(0)), like)


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
    machine = cycle_map(machine, cycles, method=method).machine
    method = torus_method(method, machine)
    start = start.last if isinstance(start, Run) else start
    like = map_state(machine, machine.start() if start is None else start, "start")
    if machine.position(without_modes(like)).dtype != jnp.float64:
        raise ValueError(
            "Argument `start` must be of double precision: call "
            '`jax.config.update("jax_enable_x64", True)` first.'
        )
    run = simulate(
        machine, like, cycles * observed, settle=cycles * settle, method=method, record="sections"
    )
    if not bool(run.successful):
        raise ValueError(
            "Argument `start` must begin a motion that can be simulated, but the run failed: "
            f"{RESULTS[run.result]}"
        )
    rows = np.asarray(in_rows(run.sections))[::cycles]
    rows = np.asarray(nearest_images(angles_in(machine, without_modes(like)), rows, rows[0]))
    measured = _measured_rotation(machine, like, rows, cycles)
    rotation = measured if rotation is None else rotation
    values, misses = _curve_through(rows, _FIRST if nodes is None else nodes, rotation)
    if misses > _NEAR:
        raise ValueError(
            "Argument `start` must settle on one closed curve on the section, but the curve with "
            f"rotation number {rotation:.6g} misses its sections by {misses:.2g} of their spread. "
            "Give the number of `cycles` after which it returns to the same curve, or `rotation`."
        )
    problem, x = _start_equations(machine, method, run.last, cycles, values, rotation)
    equations = Equations(problem)
    solved = equations.solve_near(Curve(x, rotation, np.zeros(0)))
    if solved is not None and nodes is None:
        solved = equations.refined(solved, SETTLED, MOST)
    if solved is None:
        raise ValueError(
            f"No torus with a rotation number near {rotation:.6g} was found from this run. Observe "
            "more cycles (`settle`, `observed`), or give more `nodes`."
        )
    return torus_of(solved, equations, run.last)


def torus_method(given: MethodLike, machine: AbstractMachine) -> AbstractMethod:
    # The default of `continue_orbit` has errors of some 1e-12, which would limit the residual.
    default = chosen(machine, None, FixedStep(steps_per_cycle=48))
    return fixed_step_method(given, default, machine)


def _measured_rotation(
    machine: AbstractMachine, like: State, rows: np.ndarray, cycles: int
) -> float:
    """Return the rotation number of a run that is quasi-periodic, else raise `ValueError`."""
    sizes = sizes_on_host(machine, without_modes(like), rows)
    differences = (np.abs(rows[-1] - rows[-_LONGEST - 1 : -1]) / sizes).max(axis=1)[::-1]
    repeats = np.flatnonzero(differences < _REPEATS)
    if len(repeats):
        period = count_of(cycles * (int(repeats[0]) + 1), "cycle")
        raise ValueError(
            "Argument `start` must settle on a quasi-periodic motion, but this one repeats after "
            f"{period}: find and follow that orbit."
        )
    seen = without_angles(jnp.asarray(rows), sizes, angles_in(machine, without_modes(like)))
    digits = float(agreement(seen))
    if digits < _DIGITS:
        raise ValueError(
            "Argument `start` must settle on a quasi-periodic motion, but averages over both "
            f"halves of the run agree to {digits:.2g} digits only. A slowly settling motion needs "
            "more `settle`; a chaotic one has no torus."
        )
    return float(rotation_number(seen))


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
    like, machine = orbit.state, orbit.machine
    rows, method = np.asarray(raveled(without_modes(like))[0])[None], torus_method(None, machine)
    motion, x = _start_equations(machine, method, like, int(orbit.cycles), rows, 0.0)
    equations = Equations(with_parameter(motion, parameter, width))
    point = Curve(x, 0.0, np.array([float(leaf(machine, parameter))]))
    rotation, mode = equations.rotating_mode(point)
    waves = np.exp(2j * np.pi * np.arange(_FIRST) / _FIRST)[:, None]
    mode = mode / np.linalg.norm(mode)
    circle = 2 * distance * np.real(waves * mode) * equations.scale
    # The first mode has this size and phase; ρ and the parameter are free.
    row = (waves.conj() * mode.conj()).ravel() / np.sqrt(_FIRST)
    held = [
        (np.append(part, [0.0, 0.0]), size)
        for part, size in ((row.imag, 0.0), (row.real, distance))
    ]
    solved = equations.solve(Curve(x + circle, rotation, point.p), held)
    solved = None if solved is None else equations.refined(solved, SETTLED, MOST)
    if solved is None:
        raise ValueError(
            f"No torus was found at distance {distance:g} from this Neimark–Sacker point. Try a "
            "shorter distance."
        )
    return torus_of(solved, equations, like)


def with_parameter(
    problem: Shooting, name: str, width: float, ends: tuple[float, ...] = ()
) -> Shooting:
    """Return the equations with a parameter of this size among the unknowns, with steps enough for
    these values of it."""
    corners = [problem.machine, *(with_leaf(problem.machine, name, end) for end in ends)]
    steps = steps_of(problem.method, corners, problem.like, problem.cycles)
    return dataclasses.replace(
        problem, parameters=(name,), steps=max(problem.steps, steps), widths=jnp.asarray([width])
    )
