"""`find_torus`: quasi-periodic motions as invariant curves of the section map."""

import dataclasses
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._checks import count, given_number, host_side, instance_of, on_host
from .._messages import count_of
from .._programs import compiled
from .._types import Scalar, State
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
    states_from_rows,
    with_modes,
    without_modes,
)
from .birkhoff import QUASIPERIODIC, agreement, rotation_number, weights, without_angles
from .cycle_map import CycleMap, cycle_map, map_state
from .delay import as_chain
from .equations import Observed, Shooting
from .from_orbit import (
    begins_after_jump,
    equations_along,
    fixed_step_method,
    placed_events,
    with_sections,
    with_sizes,
)
from .results import Orbit
from .special import Point
from .tolerances import LISTED, ROUGHLY, ROUNDING, SAME
from .torus_equations import (
    Curve,
    Equations,
    Solved,
    angles_of,
    begin_on_section,
    in_lanes,
    interpolated,
    modes,
)  # fmt: skip

# The first and the largest number of nodes.
_FIRST, MOST = 33, 513

# A motion repeats if sections at most so many cycles apart agree: a choice.
_LONGEST = 512

# The curve through a run is near its sections, relative to their sizes: a choice.
_NEAR = 0.1

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
        return self.at(angles_of(self.nodes))

    def at(self, angle: Any) -> State:
        """Return the states on the section at angles θ, in turns; leaves have their shape."""
        angle = np.asarray(angle, float)
        rows = self.equations.on_section(self.curve, np.mod(angle.ravel(), 1.0))
        return on_host(self.problem.unravel(rows.reshape(*angle.shape, -1)))

    @cached_property
    def tail(self) -> float:
        """The largest of the highest fifth of the Fourier modes, relative to the largest mode."""
        return self.equations.tail(self.curve)

    @cached_property
    def residual(self) -> float:
        """Largest component of P(u(θ)) - u(θ + ρ) halfway between the nodes, relative to the size
        of each. P is a simulation, which detects its events: a touch between two nodes counts."""
        angles = angles_of(self.nodes) + 0.5 / self.nodes
        begin, wanted = (
            self.equations.on_section(self.curve, angles + turn) for turn in (0.0, self.rotation)
        )
        the_map = cycle_map(self.machine, self.cycles, method=self.method)
        end = _mapped((the_map, self.problem), begin)
        end = nearest_images(angles_in(self.machine, self.problem.like), end, wanted)
        difference = (end - wanted) / np.asarray(self.problem.sizes)[1:]
        return float(np.abs(difference).max()) if np.isfinite(difference).all() else np.inf

    @cached_property
    def margins(self) -> "list[Margin]":
        """The least distances from other events, first that from stops and guards, last the speed
        of approach of each event."""
        return margins_of(self.equations, self.curve)

    @property
    def clearance(self) -> float:
        """Smallest distance to a stop at a turn that does not touch it; infinite without such a
        turn, negative if the motion would pass through the stop."""
        return self.margins[0].value

    @property
    def slowest_impact(self) -> float:
        """Smallest V⁻; infinite without impacts."""
        speeds = self.margins[-len(self.problem.events) :]
        return min((speeds[i].value for i in self.problem.impacts), default=np.inf)

    @cached_property
    def exponents(self) -> np.ndarray:
        """Lyapunov exponents per cycle, the greatest first, from the derivatives at the nodes; that
        along the curve is 0. One fewer than states if an event ends the machine's cycles."""
        matrices, along = self.equations.cocycle(self.curve)
        angles = np.mod(np.arange(_SKIPPED + _STEPS + 1) * self.rotation, 1.0)
        flat = interpolated(matrices.reshape(self.nodes, -1), angles[:-1])
        matrices, along = flat.reshape(-1, *matrices.shape[1:]), interpolated(along, angles)
        number = along.shape[1] - 1 - self.problem.autonomous
        rates = np.asarray(_growth(jnp.asarray(matrices), jnp.asarray(along), number))[_SKIPPED:]
        found = weights(_STEPS) @ rates
        first, second = weights(_STEPS // 2) @ rates.reshape(2, -1, number)
        error = np.abs(first - second)
        # A pair that turns in its plane has one exponent, but the averages of each of the two
        # converge slowly: only their sum does not depend on the directions.
        for k in range(number - 1):
            if found[k] - found[k + 1] < _PAIR * max(error[k : k + 2]):
                found[k : k + 2] = found[k : k + 2].mean()
        return np.sort(np.append(found, 0.0))[::-1] / self.cycles

    @cached_property
    def reason(self) -> str:
        """The reason why this is not a quasi-periodic motion of the machine; "" if it is one."""
        lowest = min(self.margins, key=lambda margin: margin.share)
        if first_mode(self.equations, self.curve)[1] < SAME:
            return "The curve has shrunk to a periodic motion, which any rotation number solves."
        if self.tail > ROUGHLY:
            return (
                f"The curve is not resolved by {self.nodes} nodes: its highest modes are "
                f"{self.tail:.1g} of the largest. Use more `nodes`."
            )
        if lowest.crossed:
            return f"The motion has other events than the equations: {lowest}."
        if not self.residual < ROUGHLY:
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
    """Return the logarithms of the growth of `number` directions in each step, across the
    directions `along` the curve."""
    along /= jnp.linalg.norm(along, axis=1, keepdims=True)

    def across(frame, direction):
        return frame - jnp.outer(direction, direction @ frame)

    def step(frame, inputs):
        matrix, direction = inputs
        frame, lengths = jnp.linalg.qr(across(matrix @ frame, direction))
        return frame, jnp.log(jnp.abs(jnp.diag(lengths)))

    drawn = np.random.default_rng(0).normal(size=(matrices.shape[-1], number))
    frame = jnp.linalg.qr(across(jnp.asarray(drawn), along[0]))[0]
    return jax.lax.scan(step, frame, (matrices, along[1:]))[1]


class Margin(NamedTuple):
    """A distance of the motions on a curve from another order of events, the least over all angles;
    negative beyond the change."""

    change: str
    """What changes there, in words."""
    value: float
    share: float
    """The value relative to its size along the motion."""
    angle: float
    """The place on the curve, in turns."""

    @property
    def crossed(self) -> bool:
        return not self.share >= -ROUNDING

    def __str__(self) -> str:
        return f"{self.change} at θ = {self.angle % 1:.4g}"


# Changes other than the loss of an event, in the order of `margins_of`.
TOUCH, *REORDERED = (
    "it touches a stop or a guard", "two events change their order",
    "a switch goes into another mode", "an event passes the section",
)  # fmt: skip


def margins_of(equations: Equations, curve: Curve) -> list[Margin]:
    """Return the margins; a search between the nodes closes in on the least of each."""
    problem = equations.motion(curve.p)
    values, shares = _values(problem, curve.x, equations.observe(curve))
    centre, width = np.argmin(values, axis=0) / len(values), 1.0 / len(values)
    each = np.arange(values.shape[1])
    for _ in range(_CLOSER):
        angles = centre[:, None] + width * np.linspace(-1, 1, _PLACES)
        flat = angles.ravel()
        found = _values(problem, interpolated(curve.x, flat), equations.observe(curve, flat))
        values, shares = (a.reshape(len(each), _PLACES, -1)[each, :, each] for a in found)
        index = np.clip(np.argmin(values, axis=1), 1, _PLACES - 2)
        centre, width = angles[each, index], 2.0 * width / (_PLACES - 1)
    lost = [f"the {event.name_on(problem.machine)} is missed" for event in problem.events]
    rows = np.stack([values.min(axis=1), shares.min(axis=1), centre], axis=1).tolist()
    return [Margin(c, *row) for c, row in zip([TOUCH, *REORDERED, *lost], rows, strict=True)]


def _values(problem: Shooting, x: np.ndarray, observed: Observed) -> tuple[np.ndarray, np.ndarray]:
    """Return the margins of motions, and relative to their sizes, (angles, margins)."""
    count, section = len(problem.events), np.full(len(x), np.inf)
    if count and not problem.autonomous and problem.events[0].cycle != 0:
        section = np.minimum(x[:, 0], float(problem.period(x[0])) - x[:, count - 1])
    nearest, ones = observed.nearest, np.ones(len(x))
    values = [nearest.margin, observed.order_margin, observed.modes_agree, section]
    units = [nearest.unit, problem.radian * ones, ones, problem.radian * ones]
    values = np.column_stack([*values, observed.approach])
    return values, values / np.column_stack([*units, observed.units])


def first_mode(equations: Equations, curve: Curve) -> tuple[np.ndarray, float]:
    """Return the first Fourier mode of a curve, in scaled unknowns, and its largest component."""
    mode = np.fft.fft(curve.x / equations.scale, axis=0)[1] / len(curve.x)
    return mode, float(np.abs(mode).max())


@in_lanes
def _mapped(map_and_equations: tuple[CycleMap, Shooting], row):
    the_map, problem = map_and_equations
    return raveled(the_map(begin_on_section(problem, row)))[0]


def _start_equations(
    machine: AbstractMachine, method: AbstractMethod, like: State, cycles: int, rows: np.ndarray,
    rotation: float,
) -> tuple[Equations, np.ndarray]:  # fmt: skip
    """Return the equations of the curve through some states on the section, and the unknowns of the
    motions that begin there, (nodes, unknowns)."""
    state, modes = without_modes(like), modes_of(like) or ()
    starts = [with_modes(states_from_rows(state, row), modes) for row in rows]
    problems, xs = zip(*(_followed(machine, method, s, cycles) for s in starts), strict=True)
    problem = max(problems, key=lambda p: p.steps)
    for i, other in enumerate(problems):
        if (other.events, other.modes) != (problem.events, problem.modes):
            raise ValueError(
                "Argument `start` must settle on a motion whose cycles all have the same events in "
                f"the same order, but those from θ = 0 and from θ = {i / len(rows):.3g} differ: "
                "the curve grazes between them, or an event passes the section. In the second case "
                "shift the section."
            )
    x = np.stack(xs)
    if problem.events and begins_after_jump(machine, problem.events[0]):
        # Its state is that before the jump, which ends the motion from θ - ρ.
        states = slice(problem.legs, problem.legs + problem.states)
        x[:, states] = interpolated(x[:, states], angles_of(len(rows)) - rotation)
    largest = Equations(problem).observe(Curve(x, rotation, np.zeros(0))).largest
    return Equations(with_sizes(problem, x[0], largest.max(axis=0))), x


def _followed(
    machine: AbstractMachine, method: AbstractMethod, start: State, cycles: int
) -> tuple[Shooting, np.ndarray]:
    """Return the equations of the motion from a state, and its values of the unknowns."""
    run = simulate(machine, start, cycles, method=method, event_log=LISTED + 1)
    assert run.event_log is not None
    if np.isin(run.event_log.kind, (EventKind.rest, EventKind.release)).any():
        raise ValueError(
            "Argument `start` must settle on a motion in flight, but it rests on a stop. Tori of "
            "motions that rest are not supported."
        )
    begins, found = placed_events(machine, run, "start")
    found = with_sections(machine, without_modes(start), begins, found, cycles)
    return equations_along(machine, method, start, found, float(begins[-1]), cycles, [machine])


def torus_of(solved: Solved, equations: Equations) -> Torus:
    return Torus(equations.motion(solved.curve.p), solved.curve._replace(p=np.zeros(0)))


@host_side
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
      `vi.turn_of`. One with delays is replaced by `delay_chain(machine)`.
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
    machine, start = as_chain(machine, start.last if isinstance(start, Run) else start)
    machine = cycle_map(machine, cycles, method=method).machine
    method = torus_method(method, machine)
    start = machine.start() if start is None else start
    run = _settled(machine, method, start, cycles, settle, observed)
    rows = in_rows(run.sections)[::cycles]
    rows = np.asarray(nearest_images(angles_in(machine, without_modes(run.last)), rows, rows[0]))
    measured = _measured_rotation(machine, without_modes(run.last), rows, cycles)
    rotation = measured if rotation is None else rotation
    values = _curve_through(rows, _FIRST if nodes is None else nodes, rotation)
    equations, x = _start_equations(machine, method, run.last, cycles, values, rotation)
    solved = equations.solve_near(Curve(x, rotation, np.zeros(0)))
    solved = equations.refined(solved, MOST if nodes is None else nodes)
    if solved is None:
        raise ValueError(
            f"No torus with a rotation number near {rotation:.6g} was found from this run. Observe "
            "more cycles (`settle`, `observed`), or give more `nodes`."
        )
    return torus_of(solved, equations)


def _settled(
    machine: AbstractMachine, method: AbstractMethod, start: Any, cycles: int, settle: int,
    observed: int,
) -> Run:  # fmt: skip
    """Return the sections of so many periods of the motion on which a start settles."""
    like = map_state(machine, start, "start")
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
    return run


def torus_method(given: MethodLike, machine: AbstractMachine) -> AbstractMethod:
    # The default of `continue_orbit` has errors of some 1e-12, which would limit the residual.
    default = chosen(machine, None, FixedStep(steps_per_cycle=48))
    return fixed_step_method(given, default, machine)


def _measured_rotation(
    machine: AbstractMachine, like: State, rows: np.ndarray, cycles: int
) -> float:
    """Return the rotation number of a run that is quasi-periodic, else raise `ValueError`."""
    sizes = sizes_on_host(machine, like, rows)
    differences = (np.abs(rows[-1] - rows[-_LONGEST - 1 : -1]) / sizes).max(axis=1)[::-1]
    repeats = np.flatnonzero(differences < ROUGHLY)
    if len(repeats):
        period = count_of(cycles * (int(repeats[0]) + 1), "cycle")
        raise ValueError(
            "Argument `start` must settle on a quasi-periodic motion, but this one repeats after "
            f"{period}: find and follow that orbit."
        )
    angles = angles_in(machine, like)
    angles = None if angles is None else tuple(angles.tolist())  # static
    digits, turns = (float(x) for x in _averages(rows, sizes, angles))
    if digits < QUASIPERIODIC:
        raise ValueError(
            "Argument `start` must settle on a quasi-periodic motion, but averages over both "
            f"halves of the run agree to {digits:.2g} digits only. A slowly settling motion needs "
            "more `settle`; a chaotic one has no torus."
        )
    return turns


@compiled
def _averages(rows: Any, sizes: Any, angles: tuple | None) -> tuple[Scalar, Scalar]:
    """Return the digits to which averages of a run agree, and its rotation number."""
    seen = without_angles(rows, sizes, None if angles is None else np.asarray(angles))
    return agreement(seen), rotation_number(seen)


def _curve_through(rows: np.ndarray, nodes: int, rotation: float) -> np.ndarray:
    """Return the states at the nodes of the closed curve through the sections of a run. Its modes
    are weighted averages."""
    waves = np.exp(-2j * np.pi * np.outer(modes(nodes), np.arange(len(rows)) * rotation % 1.0))
    coefficients = (waves * weights(len(rows))) @ rows
    missed = rows - np.real(waves.conj().T @ coefficients)
    misses = float((missed.std(axis=0) / np.maximum(rows.std(axis=0), 1e-300)).max())
    if misses > _NEAR:
        raise ValueError(
            "Argument `start` must settle on one closed curve on the section, but the curve with "
            f"rotation number {rotation:.6g} misses its sections by {misses:.2g} of their spread. "
            "Give the number of `cycles` after which it returns to the same curve, or `rotation`."
        )
    return np.fft.ifft(coefficients * nodes, axis=0).real


def torus_near(orbit: Orbit, parameter: str, width: float, distance: float) -> Torus:
    """Return the torus near a Neimark–Sacker point whose first mode has the size `distance`, in
    scaled unknowns; the parameter is an unknown."""
    like, machine = orbit.state, orbit.machine
    rows, method = np.asarray(raveled(without_modes(like))[0])[None], torus_method(None, machine)
    motion, x = _start_equations(machine, method, like, int(orbit.cycles), rows, 0.0)
    equations = Equations(
        dataclasses.replace(motion.problem, parameters=(parameter,), widths=jnp.asarray([width]))
    )
    point = Curve(x, 0.0, np.array([float(leaf(machine, parameter))]))
    rotation, mode = equations.rotating_mode(point)
    waves = np.exp(2j * np.pi * angles_of(_FIRST))[:, None]
    mode = mode / np.linalg.norm(mode)
    circle = 2 * distance * np.real(waves * mode) * equations.scale
    # The first mode has this size and phase; ρ and the parameter are free.
    row = (waves.conj() * mode.conj()).ravel() / np.sqrt(_FIRST)
    held = [(np.append(row.imag, [0.0, 0.0]), 0.0), (np.append(row.real, [0.0, 0.0]), distance)]
    solved = equations.solve(Curve(x + circle, rotation, point.p), held)
    solved = equations.refined(solved, MOST)
    if solved is None:
        raise ValueError(
            f"No torus was found at distance {distance:g} from this Neimark–Sacker point. Try a "
            "shorter distance."
        )
    return torus_of(solved, equations)
