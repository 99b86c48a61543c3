# %% [markdown]
# # Speed against accuracy
#
# Every method on the same lanes: Table 1's machine (d = 2, k = 0.8; the motor with T0 = 10 N·m),
# 256 values of ζ (ideal drive) or κ (motor) from 0.5 to 1.9, from rest. What a method costs is told
# beside what it gets wrong: the state after few and after many cycles, impact times and counts,
# extremes, orbits with their multipliers and derivatives, how soon it loses a chaotic motion, and
# how often the *regime* comes out wrong, which is what a scan is for.
#
# Truth is `ExactFlight` for the ideal drive and 40 steps of Verner9 a cycle for the motor. Errors
# are over the lanes that amplify a displacement of 1e-10 to no more than 1e-6 in 1,000 cycles. Run
# times are medians of five interleaved rounds of 200 cycles, compiled before; what takes one
# thread is measured on one thread.
#
# Run with `python experiments/benchmarks/speed_accuracy.py` (`--quick` for few methods and lanes of
# the ideal drive).

# %%
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import vi_jax as vi
from matplotlib.figure import Figure
from vi_jax.plot.colors import BLUE, GREEN, MORE_IMPACTS, ORANGE, PERIODS, RED

jax.config.update("jax_enable_x64", True)
# Single precision is one of the things compared here.
warnings.filterwarnings("ignore", message="vi_jax is running in single precision")
warnings.filterwarnings("ignore", message="[0-9,]+ of [0-9,]+ lanes failed")

HERE = Path(__file__).parent if "__file__" in globals() else Path("experiments/benchmarks")
sys.path.insert(0, str(HERE.parent))
from headlines import keep

QUICK = "--quick" in sys.argv
LANES, MANY, FEW, TIMED, ROUNDS = (64, 60, 20, 20, 3) if QUICK else (256, 1000, 20, 200, 5)
GRID = 8 if QUICK else 32
DRIVES = ("ideal",) if QUICK else ("ideal", "motor")
TABLE = vi.Parameters(torque=10.0, restitution=0.8, gap=0.08)
TARGETS = (1e-3, 1e-6, 1e-9, 1e-12)
BEGIN = time.perf_counter()


def note(text: str) -> None:
    """A line on how far the work is."""
    print(f"{time.perf_counter() - BEGIN:6.0f} s  {text}", file=sys.stderr, flush=True)


# %% [markdown]
# ## Methods


# %%
class Choice(NamedTuple):
    """A method and a precision."""

    family: str
    label: str
    method: vi.AbstractMethod
    double: bool = True

    @property
    def name(self) -> str:
        """As in the tables."""
        return f"{self.family}, {self.label}"


def named(solver: str) -> Any:
    """A solver of vi_jax's or diffrax's."""
    return vi.Verner9() if solver == "Verner9" else getattr(diffrax, solver)()


def fixed(solver: str, steps: int, *, double: bool = True) -> Choice:
    """Fixed steps."""
    single = "" if double else ", float32"
    method = vi.FixedStep(named(solver), steps)
    return Choice(f"FixedStep {solver}{single}", f"{steps} steps", method, double)


def adaptive(solver: str, tolerance: float, *, double: bool = True) -> Choice:
    """Steps by a tolerance."""
    single = "" if double else ", float32"
    method = vi.Adaptive(named(solver), rtol=tolerance)
    return Choice(f"Adaptive {solver}{single}", f"{tolerance:.0e}", method, double)


def series(order: int, tolerance: float) -> Choice:
    """Power series, their steps by a tolerance."""
    return Choice(f"Taylor {order}", f"{tolerance:.0e}", vi.Taylor(order, rtol=tolerance))


def series_of(order: int) -> Choice:
    """Power series in eight steps a cycle."""
    return Choice("Taylor, 8 steps", f"order {order}", vi.Taylor(order, 8))


EXACT = Choice("ExactFlight", "closed form", vi.ExactFlight())
if QUICK:
    CARRIED = [fixed("Verner9", 10), adaptive("Verner9", 1e-9)]
else:
    CARRIED = [
        *(fixed("Verner9", n) for n in (5, 6, 8, 10, 12, 16, 20, 30)),
        *(fixed("Dopri8", n) for n in (5, 6, 8, 12, 16, 24, 32, 48)),
        *(fixed("Tsit5", n) for n in (5, 8, 16, 32, 64, 128)),
        *(fixed("Dopri5", n) for n in (8, 32, 128)),
        *(fixed("Bosh3", n) for n in (16, 64, 256)),
        *(adaptive("Verner9", 10.0**-n) for n in (2, 4, 6, 8, 9, 10, 12, 13)),
        *(adaptive("Dopri8", 10.0**-n) for n in (4, 6, 9, 12)),
        *(adaptive("Tsit5", 10.0**-n) for n in (3, 5, 7, 9, 11)),
        *(adaptive("Dopri5", 10.0**-n) for n in (3, 6, 9)),
        *(adaptive("Bosh3", 10.0**-n) for n in (3, 5, 7)),
        *(series(12, 10.0**-n) for n in (5, 7, 9)),
        *(series(16, 10.0**-n) for n in (7, 9, 11)),
        *(series(20, 10.0**-n) for n in (9, 11, 12, 13, 14)),
        *(series_of(n) for n in (10, 12, 14, 16, 18, 20)),
        fixed("Verner9", 6, double=False),
        fixed("Tsit5", 16, double=False),
        adaptive("Verner9", 1e-5, double=False),
    ]
SCANNED = {
    "ExactFlight, closed form",
    "ExactFlight, float32, closed form",
    *(fixed("Verner9", n).name for n in (5, 6, 10, 16)),
    *(fixed("Dopri8", n).name for n in (6, 12)),
    fixed("Tsit5", 16).name,
    fixed("Verner9", 6, double=False).name,
    series(16, 1e-9).name,
    series(20, 1e-13).name,
    series_of(14).name,
    *(choice.name for choice in CARRIED if choice.method.adaptive and choice.double),
}
TRUTH = {"ideal": EXACT, "motor": fixed("Verner9", 40)}
SINGLE_EXACT = EXACT._replace(family="ExactFlight, float32", double=False)
CHOICES = {"ideal": [EXACT, SINGLE_EXACT, *CARRIED], "motor": CARRIED}


SCENES = {drive: jtu.tree_map(np.asarray, TABLE.scene(drive=drive)) for drive in DRIVES}


def scene_of(drive: str, ratio: Any, restitution: Any = 0.8) -> vi.Scene:
    """Table 1's machine at ζ (ideal drive) or κ (motor) = `ratio`, in the precision in force."""
    scene = jtu.tree_map(jnp.asarray, SCENES[drive])

    def numbers(scene):
        drive = scene.drive
        ratio = drive.frequency_ratio if isinstance(drive, vi.IdealDrive) else drive.control
        return ratio, scene.stops[0].restitution

    return eqx.tree_at(numbers, scene, (jnp.asarray(ratio), jnp.asarray(restitution)))


def ratios(lanes: int) -> np.ndarray:
    """ζ or κ of the lanes."""
    return np.linspace(0.5, 1.9, lanes)


class Program(NamedTuple):
    """A compiled batch on its arguments."""

    run: Callable[[], Any]
    compiling: float


_compiled: dict[tuple, tuple[Any, float]] = {}


def carried(kind: str, choice: Choice, function: Callable, *arguments: np.ndarray) -> Program:
    """`function` of a method and a batch, compiled in the choice's precision.

    Tolerances are arguments of the program: a family of adaptive methods is one program.
    """
    tolerances, rest = eqx.partition(choice.method, lambda x: isinstance(x, np.ndarray))
    with jax.enable_x64(choice.double):
        batch = [jtu.tree_map(jnp.asarray, x) for x in (tolerances, *arguments)]
        key = (kind, choice.family, "" if choice.method.adaptive else choice.label)
        if key not in _compiled:

            def program(tolerances, *batch):
                return function(eqx.combine(tolerances, rest), *batch)

            begin = time.perf_counter()
            compiled = vi.jit(program).lower(*batch).compile()
            _compiled[key] = compiled, time.perf_counter() - begin
    compiled, seconds = _compiled[key]
    return Program(lambda: jax.block_until_ready(compiled(*batch)), seconds)


def forget(*kinds: str) -> None:
    """Let go of compiled programs: a process can hold only so many pieces of memory."""
    for key in [key for key in _compiled if key[0].endswith(kinds)]:
        del _compiled[key]
    jax.clear_caches()


# %% [markdown]
# ## What goes wrong with the motion
#
# One run of many cycles from rest gives all of it: the states after few and many cycles, and in the
# first few cycles the impact phases, impact counts and extremes.


# %%
class Seen(NamedTuple):
    """What a method says of all lanes."""

    states: np.ndarray
    """(lanes, cycles + 1, parts of the state)"""
    phase: np.ndarray
    counts: np.ndarray
    y_min: np.ndarray
    good: np.ndarray


def observe(choice: Choice, drive: str, *, shift: float = 0.0) -> Seen:
    """The motion of all lanes."""

    def lane(method, ratio, shift):
        scene = scene_of(drive, ratio)
        start = scene.start(Y=shift)
        # With d = 2 nothing presses the body on, which a traced gap does not show.
        rests = {"method": method, "rests": False}
        long = vi.simulate(scene, start, MANY, record="sections", **rests)
        short = vi.simulate(scene, start, FEW, impact_log=3, **rests)
        assert short.impact_log is not None
        states = jnp.stack(jtu.tree_leaves(long.sections), axis=-1)
        return states, short.impact_log.phase, short.impacts, short.y_min, long.successful

    batch = jax.vmap(lane, in_axes=(None, 0, 0))
    program = carried(f"{drive} seen", choice, batch, ratios(LANES), np.full(LANES, shift))
    found = program.run()
    return Seen(*(np.asarray(x) for x in found))


def differ(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The largest difference in each lane; infinite where one of them is no number."""
    apart = np.abs(a.astype(float) - b.astype(float)).reshape(len(a), -1)
    same = np.isnan(a.reshape(len(a), -1)) & np.isnan(b.reshape(len(b), -1))
    return np.where(same, 0, np.where(np.isfinite(apart), apart, np.inf)).max(axis=1)


def most(errors: np.ndarray) -> float:
    """What 95 of 100 lanes stay under."""
    return float(np.quantile(errors, 0.95, method="higher"))


def errors_of(seen: Seen, truth: Seen, calm: np.ndarray) -> dict[str, float]:
    """Errors over the calm lanes."""
    counted = (seen.counts == truth.counts).all(axis=1)
    both = calm & counted
    few = differ(seen.states[:, FEW], truth.states[:, FEW])[calm]
    many = differ(seen.states[:, -1], truth.states[:, -1])[calm]
    return {
        "state": float(np.median(few)),
        "state95": most(few),
        "late": float(np.median(many)),
        "late95": most(many),
        "phase95": most(differ(seen.phase, truth.phase)[both]) if both.any() else np.inf,
        "extremes95": most(differ(seen.y_min, truth.y_min)[calm]),
        "counts": float(np.mean(~counted[calm])),
        "lost": float(np.mean(many > 1e-2)),
        "failed": float(np.mean(~seen.good)),
    }


# %% [markdown]
# ## What it costs


# %%
def timed(choice: Choice, drive: str, *, alone: bool = False) -> Program:
    """A run of all lanes, or of one, for the clock."""

    def lane(method, ratio):
        scene = scene_of(drive, ratio)
        run = vi.simulate(
            scene, scene.start(), TIMED, method=method, record="sections", rests=False
        )
        return run.last

    if alone:
        return carried(f"{drive} alone", choice, lane, np.array(0.9))
    return carried(f"{drive} timed", choice, jax.vmap(lane, in_axes=(None, 0)), ratios(LANES))


def race(programs: list[Program]) -> list[float]:
    """Median seconds of each, in interleaved rounds."""
    times: list[list[float]] = [[] for _ in programs]
    for _ in range(ROUNDS):
        for program, seconds in zip(programs, times, strict=True):
            begin = time.perf_counter()
            program.run()
            seconds.append(time.perf_counter() - begin)
    return [float(np.median(seconds)) for seconds in times]


# %% [markdown]
# ## Regimes
#
# A scan over ζ (or κ) and k, from rest; its labels (period, impacts in a period) beside those of
# the truth. A lane where two true methods (the truth and `Adaptive` at 1e-13) differ is chaotic or
# lies on a border; it is told apart.


# %%
AXES = {
    "ideal": {
        "drive.frequency_ratio": np.linspace(0.5, 1.9, GRID),
        "stops.0.restitution": np.linspace(0.1, 0.95, GRID),
    },
    "motor": {
        "drive.control": np.linspace(0.5, 1.9, GRID),
        "stops.0.restitution": np.linspace(0.1, 0.95, GRID),
    },
}


def regimes(choice: Choice, drive: str) -> tuple[np.ndarray, float]:
    """Labels, and the seconds of a second run."""
    with jax.enable_x64(choice.double):
        scene = jtu.tree_map(jnp.asarray, SCENES[drive])
        axes = {name: x.astype(jnp.result_type(float)) for name, x in AXES[drive].items()}
        measure = vi.Regime(longest=16, observed=128, tolerance=1e-6 if choice.double else 1e-3)

        def once():
            begin = time.perf_counter()
            data = vi.scan(
                scene, axes, measure=measure, settle=60 if QUICK else 400, method=choice.method,
                progress=False,
            )  # fmt: skip
            labels = np.stack([data.period, np.where(data.period > 0, data.impacts, 0)])
            return labels, time.perf_counter() - begin

        once()
        return once()


# %% [markdown]
# ## Orbits, multipliers, derivatives


# %%
def cycle(choice: Choice, drive: str, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One drive cycle from eight section states, and its derivatives by state and ζ (or κ)."""

    def one(method, ratio, state):
        def after(numbers):
            scene = scene_of(drive, numbers[-1])
            names = ("Y", "V", "W")[: state.size]
            start = scene.start(**dict(zip(names, numbers, strict=False)))
            run = vi.simulate(scene, start, 1, method=method, record="sections", rests=False)
            return jnp.stack(jtu.tree_leaves(run.last))

        numbers = jnp.append(state, ratio)
        return after(numbers), jax.jacfwd(after)(numbers)

    batch = jax.vmap(one, in_axes=(None, 0, 0))
    after, slope = carried(f"{drive} cycle", choice, batch, ON, states).run()
    return np.asarray(after), np.asarray(slope)


ON = np.linspace(1.05, 1.4, 8)


def orbit_of(
    choice: Choice, drive: str, states: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The 2π motions near `states` by Newton's method: states, multipliers, d(state)/dζ."""
    slope = matrix = np.empty(0)
    for _ in range(8):
        after, slope = cycle(choice, drive, states)
        matrix = np.eye(states.shape[1]) - slope[:, :, :-1]
        states = states + np.linalg.solve(matrix, (after - states)[..., None])[..., 0]
    multipliers = np.sort_complex(np.linalg.eigvals(slope[:, :, :-1]))
    return states, multipliers, np.linalg.solve(matrix, slope[:, :, -1:])[..., 0]


def guesses(drive: str) -> np.ndarray:
    """The closed forms of the ideal drive."""
    scenes = [vi.Scene.ideal(frequency_ratio=x, restitution=0.8) for x in ON]
    found = [vi.closed_form_orbits(scene, cycles=1) for scene in scenes]
    states = np.array([[float(x.Y[0]), float(x.V[0])] for x in found])
    return states if drive == "ideal" else np.column_stack([states, ON])


# %% [markdown]
# ## Chaos
#
# In a chaotic motion (here without damping) no method keeps to the truth; the cycles until the
# error exceeds 1e-3 grow with the logarithm of its accuracy.


# %%
def undamped(scene: vi.Scene) -> vi.Scene:
    """Without damping there is more chaos."""
    return eqx.tree_at(lambda s: s.oscillator.damping_ratio, scene, jnp.zeros(()))


def horizon(choice: Choice, drive: str, truth: np.ndarray | None) -> tuple[np.ndarray, float]:
    """States, and the median cycle at which they part from the truth."""

    def lane(method, ratio, Y):
        scene = undamped(scene_of(drive, ratio))
        run = vi.simulate(
            scene, scene.start(Y=Y), 200, method=method, record="sections", rests=False
        )
        return jnp.stack([run.sections.Y, run.sections.V], axis=-1)

    batch = jax.vmap(lane, in_axes=(None, 0, 0))
    lanes = np.full(32, CHAOTIC), np.linspace(-1, 1, 32)
    found = np.asarray(carried(f"{drive} chaos", choice, batch, *lanes).run())
    if truth is None:
        return found, np.nan
    apart = np.abs(found - truth).max(axis=-1)
    apart = np.where(np.isfinite(apart), apart, np.inf)
    first = np.where((apart > 1e-3).any(axis=1), (apart > 1e-3).argmax(axis=1), 200)
    return found, float(np.median(first))


def most_chaotic(drive: str) -> tuple[float, float]:
    """The ζ or κ of the greatest Lyapunov exponent (unit: ω), and that exponent."""
    name = next(iter(AXES[drive]))
    values = np.linspace(0.5, 1.9, 15 if QUICK else 141)
    scene = undamped(jtu.tree_map(jnp.asarray, SCENES[drive]))
    data = vi.scan(scene, {name: values}, measure=vi.Exponent(), settle=200, progress=False)
    best = int(np.argmax(data.exponent.values))
    return float(values[best]), float(data.exponent[best])


# %% [markdown]
# ## The landing, taken apart
#
# What the hybrid step does at an impact, beside what is simpler: the same steps on the 4π
# motion (ζ = 0.9, k = 0.5, undamped), 4 cycles, with
#
# - no landing: a step that ends beyond the stop is taken and its velocity reversed there;
# - the interpolant: the state on the stop is read off a cubic Hermite polynomial of the step;
# - a landing: a step that ends on the stop, aimed by the interpolant and then by Newton's method
#   until it is within 1e-3, 1e-6 or 1e-9 of it, where the jump is applied;
# - a landing with its correction: the same, with the second-order Taylor step onto the stop.


# %%
ORBIT = vi.closed_form_orbits(vi.Scene.ideal(frequency_ratio=0.9), cycles=2)
SOLVER = vi.Unrolled(vi.Verner9())


def pulled(s: Any, y: Any) -> Any:
    """d(Y, V)/dφ of the undamped machine at ζ = 0.9."""
    return jnp.stack([y[1], jnp.cos(s) - y[0]]) / 0.9


def moved(s: Any, y: Any, h: Any) -> Any:
    """One step."""
    term = diffrax.ODETerm(lambda s, y, args: pulled(s, y))
    return SOLVER.step(term, s, s + h, y, None, None, made_jump=True)[0]


def crossing(s: Any, y0: Any, y1: Any, h: Any) -> tuple[Any, Any]:
    """Where the Hermite cubic of a step meets the stop (share of the step), and its state there."""
    f0, f1 = pulled(s, y0), pulled(s + h, y1)

    def at(t):
        a, b = (1 + 2 * t) * (1 - t) ** 2, t * (1 - t) ** 2
        c, d = t * t * (3 - 2 * t), t * t * (t - 1)
        return a * y0 + b * h * f0 + c * y1 + d * h * f1

    def halved(_, ends):
        low, high = ends
        middle = 0.5 * (low + high)
        beyond = at(middle)[0] > 2.0
        return jnp.where(beyond, low, middle), jnp.where(beyond, middle, high)

    ends = jax.lax.fori_loop(0, 60, halved, (jnp.zeros_like(h), jnp.ones_like(h)))
    share = jax.lax.stop_gradient(0.5 * (ends[0] + ends[1]))
    g, slope = at(share)[0] - 2.0, jax.jvp(at, (share,), (jnp.ones_like(share),))[1][0]
    share = share - g / jax.lax.stop_gradient(slope)  # its derivative, by the implicit function
    return share, at(share)


def through(y: Any, how: str, steps: int, close: float = 0.0) -> Any:
    """The section state four cycles after `y`."""
    h = jnp.asarray(2 * np.pi / steps)

    def step(y, i):
        s = 2 * np.pi * (i % steps) / steps
        free = moved(s, y, h)
        hit = (free[0] > 2.0) & (free[1] > 0)
        if how == "none":
            return jnp.where(hit, jnp.stack([free[0], -0.5 * free[1]]), free), None
        share, there = crossing(s, y, free, h)
        place = share * h
        if how != "interpolant":
            place = jax.lax.stop_gradient(place)
            for _ in range(6):
                there = moved(s, y, place)
                offset = (2.0 - there[0]) / pulled(s + place, there)[0]
                further = jax.lax.stop_gradient(jnp.where(jnp.abs(offset) > close, offset, 0.0))
                place = place + further
            there = moved(s, y, place)
            if how == "corrected":
                rate = pulled(s + place, there)
                bend = jax.jvp(pulled, (s + place, there), (jnp.ones_like(h), rate))[1]
                away = 2.0 - there[0]
                offset = away / rate[0]
                offset = away / (rate[0] + 0.5 * bend[0] * offset)
                there = there + offset * rate + 0.5 * offset**2 * bend
                place = place + offset
        struck = jnp.stack([there[0], -0.5 * there[1]])
        after = moved(s + place, struck, h - place)
        return jnp.where(hit, after, free), None

    return jax.lax.scan(step, y, jnp.arange(4 * steps))[0]


def landings() -> list[tuple[str, int, float, float]]:
    """Errors of the state and of its derivative by the start, for each way and number of steps."""
    scene = vi.Scene.ideal(frequency_ratio=0.9)
    start = scene.start(Y=ORBIT.Y[0] + 0.01, V=ORBIT.V[0])
    exact = vi.cycle_map(scene, 4)
    after, slope = exact(start), np.asarray(exact.jacobian(start))
    state = np.array([float(after.Y), float(after.V)])
    y = jnp.stack([start.Y, start.V])
    ways = [("no landing", "none", 0.0), ("interpolant", "interpolant", 0.0)]
    for close in (1e-6,) if QUICK else (1e-3, 1e-6, 1e-9):
        ways.append((f"landing within {close:.0e}", "landing", close))
        ways.append((f"the same, corrected ({close:.0e})", "corrected", close))
    rows = []
    for name, how, close in ways:
        for steps in (16,) if QUICK else (16, 64, 256):
            run = jax.jit(lambda y, h=how, n=steps, c=close: through(y, h, n, c))
            error = np.abs(np.asarray(run(y)) - state).max()
            wrong = np.abs(np.asarray(jax.jacfwd(run)(y)) - slope).max() / np.abs(slope).max()
            rows.append((name, steps, float(error), float(wrong)))
    return rows


# %% [markdown]
# ## All of it


# %%
class Row(NamedTuple):
    """A method on one scene."""

    choice: Choice
    errors: dict[str, float]
    compiling: float
    seconds: float
    wrong: float
    scanning: float


def rows_of(drive: str) -> tuple[list[Row], dict[str, float]]:
    """Every method on one scene, and figures about the lanes."""
    truth, moved_on = observe(TRUTH[drive], drive), observe(TRUTH[drive], drive, shift=1e-10)
    calm = differ(truth.states, moved_on.states) < 1e-6
    note(f"{drive}: {calm.sum()} of {LANES} lanes are calm")
    sure, _ = regimes(TRUTH[drive], drive)
    second, _ = regimes(adaptive("Verner9", 1e-13), drive)
    firm = (sure == second).all(axis=0)
    note(f"{drive}: {firm.sum()} of {firm.size} regimes are firm")
    found, family = [], ""
    for choice in CHOICES[drive]:
        if choice.family != family or not choice.method.adaptive:
            forget("seen")
        family = choice.family
        errors = errors_of(observe(choice, drive), truth, calm)
        wrong, scanning = np.nan, np.nan
        if choice.name in SCANNED:
            labels, scanning = regimes(choice, drive)
            wrong = float(np.mean((labels != sure).any(axis=0)[firm]))
        found.append((choice, errors, wrong, scanning, timed(choice, drive)))
        note(f"{drive}: {choice.name}: {errors['late95']:.1e}, regimes wrong {wrong:.4f}")
    seconds = race([program for *_, program in found])
    forget("seen", "timed")
    rows = [
        Row(choice, errors, program.compiling, took, wrong, scanning)
        for (choice, errors, wrong, scanning, program), took in zip(found, seconds, strict=True)
    ]
    return rows, {"calm": int(calm.sum()), "firm": int(firm.sum()), "grid": int(firm.size)}


if QUICK:
    FEWER = CARRIED
else:
    FEWER = [
        *(fixed("Verner9", n) for n in (6, 10, 16, 30)),
        *(adaptive("Verner9", t) for t in (1e-6, 1e-9, 1e-12)),
        series(16, 1e-9),
        series(20, 1e-13),
    ]
results = {drive: rows_of(drive) for drive in DRIVES}

# %%
alone: dict[str, list[tuple[Choice, float]]] = {}
found_orbits: dict[str, list[tuple[Choice, list[float]]]] = {}
horizons: list[tuple[Choice, float]] = []
CHAOTIC = rate = 0.0
for drive in DRIVES:
    fewer = [*([EXACT] if drive == "ideal" else []), *FEWER]
    seconds = race([timed(choice, drive, alone=True) for choice in fewer])
    alone[drive] = list(zip(fewer, seconds, strict=True))
    right = orbit_of(TRUTH[drive], drive, guesses(drive))
    found_orbits[drive] = []
    for choice in fewer:
        mine = orbit_of(choice, drive, right[0])
        wrongs = [float(np.abs(a - b).max()) for a, b in zip(mine, right, strict=True)]
        found_orbits[drive].append((choice, wrongs))
    if drive == "ideal":
        CHAOTIC, rate = most_chaotic(drive)
        true_states, _ = horizon(TRUTH[drive], drive, None)
        horizons = [(choice, horizon(choice, drive, true_states)[1]) for choice in fewer]
    note(f"{drive}: orbits and chaos")
    forget("alone", "cycle", "chaos")
taken_apart = landings()
note("measured")

# %% [markdown]
# ## The front


# %%
def fastest(rows: list[Row], target: float) -> list[Row]:
    """The methods whose error 95 lanes in 100 keep below `target`, the fastest first.

    The error is that of the state after many cycles; of each family the fastest only.
    """
    good = sorted(
        (row for row in rows if row.errors["late95"] <= target), key=lambda row: row.seconds
    )
    first: dict[str, Row] = {}
    for row in good:
        first.setdefault(row.choice.family, row)
    return list(first.values())


def scanned(row: Row) -> str:
    """What the scan said, where there was one."""
    return "– | –" if np.isnan(row.wrong) else f"{row.wrong:.2%} | {row.scanning:.1f}"


def in_words(row: Row) -> str:
    """A method and what it costs."""
    return f"{row.choice.name} ({1e3 * row.seconds:.0f} ms, {row.errors['late95']:.0e})"


lines = [
    "# Speed against accuracy",
    "",
    f"{LANES} lanes, ζ (ideal drive) or κ (motor) from 0.5 to 1.9, Table 1's machine, d = 2, "
    f"k = 0.8. JAX {jax.__version__}. Times: {TIMED} cycles of all lanes, medians of {ROUNDS} "
    "interleaved rounds. Errors are those that 95 of 100 calm lanes stay under (calm: a "
    f"displacement of 1e-10 grows to no more than 1e-6 in {MANY} cycles).",
    "",
    "![Speed against accuracy](../figures/speed_accuracy.png)",
    "",
    "The map of a fixed-step method has periodic motions of its own, which repeat to rounding: its "
    "regimes come out right even where its states are off by 1e-5. With steps by a tolerance the "
    "sections wander within that tolerance, and a motion counts as unsettled unless it is well "
    "below the 1e-6 by which sections are compared.",
    "",
    "## The fastest for an error",
    "",
    f"The error is that of the state after {MANY} cycles; of each family its fastest setting. In "
    "brackets time and error.",
    "",
    "| scene | error up to | fastest | next family | ratio | third | ratio |",
    "|---|---|---|---|---|---|---|",
]
for drive, (rows, _) in results.items():
    for target in TARGETS:
        front = fastest(rows, target)[:3]
        cells = [in_words(front[0])] if front else ["none"]
        for row in front[1:]:
            cells += [in_words(row), f"{row.seconds / front[0].seconds:.2f}"]
        cells += [""] * (5 - len(cells))
        lines.append(f"| {drive} | {target:.0e} | {' | '.join(cells)} |")
for drive, (rows, about) in results.items():
    lines += [
        "",
        f"## Every method, {drive} drive",
        "",
        f"{about['calm']} of {LANES} lanes are calm. Regimes: {GRID} x {GRID} values of "
        f"{'ζ' if drive == 'ideal' else 'κ'} and k, 400 cycles to settle; wrong labels among the "
        f"{about['firm']} of {about['grid']} lanes on which two true methods agree (the others are "
        "chaotic or on a border).",
        "",
        f"| method | compile s | run ms | state, {FEW} cycles: median | 95 % | {MANY} cycles: "
        "median | 95 % | impact phase | min Y | counts wrong | off by 0.01 | failed | regime wrong "
        "| scan s |",
        "|" + "---|" * 14,
    ]
    for row in rows:
        e = row.errors
        lines.append(
            f"| {row.choice.name} | {row.compiling:.1f} | {1e3 * row.seconds:.0f} | "
            f"{e['state']:.0e} | {e['state95']:.0e} | {e['late']:.0e} | {e['late95']:.0e} | "
            f"{e['phase95']:.0e} | {e['extremes95']:.0e} | {e['counts']:.2%} | {e['lost']:.2%} | "
            f"{e['failed']:.2%} | {scanned(row)} |"
        )
lines += [
    "",
    "## One lane alone",
    "",
    "A batch steps in lockstep and waits for rejected steps; one lane does not.",
    "",
    f"| scene | method | {TIMED} cycles, ms |",
    "|---|---|---|",
]
for drive, pairs in alone.items():
    lines += [f"| {drive} | {choice.name} | {1e3 * t:.2f} |" for choice, t in pairs]
lines += [
    "",
    "## Orbits",
    "",
    "Eight 2π motions (ζ or κ from 1.05 to 1.4), found by Newton's method: largest error of the "
    "section state, of the Floquet multipliers and of d(state)/dζ (or κ).",
    "",
    "| scene | method | state | multipliers | derivative |",
    "|---|---|---|---|---|",
]
for drive, pairs in found_orbits.items():
    lines += [
        f"| {drive} | {choice.name} | {state:.0e} | {multipliers:.0e} | {slope:.0e} |"
        for choice, (state, multipliers, slope) in pairs
    ]
lines += [
    "",
    "## Chaos",
    "",
    "Ideal drive without damping: cycles until a run is off by 1e-3 (median of 32 starts) at "
    f"ζ = {CHAOTIC:.2f}, where the greatest Lyapunov exponent is {rate:.3f} ω.",
    "",
    "| method | cycles |",
    "|---|---|",
    *(
        f"| {choice.name} | {cycles:.0f} |"
        for choice, cycles in horizons
        if choice.name != EXACT.name
    ),
    "",
    "## The landing, taken apart",
    "",
    "Steps of Verner9 on the undamped 4π motion (ζ = 0.9, k = 0.5), displaced by 0.01, four "
    "cycles; relative error of the derivative by the start.",
    "",
    "| at an impact | steps a cycle | error of the state | of its derivative |",
    "|---|---|---|---|",
    *(f"| {name} | {n} | {error:.0e} | {wrong:.0e} |" for name, n, error, wrong in taken_apart),
    "",
]
report = "\n".join(lines)
print(report)


# %% [markdown]
# ## Figure


# %%
STYLE = {
    "ExactFlight": ("k", "*"),
    "FixedStep Verner9": (PERIODS[8], "s"),
    "FixedStep Dopri8": (BLUE, "s"),
    "FixedStep Tsit5": (RED, "s"),
    "FixedStep Dopri5": (GREEN, "s"),
    "FixedStep Bosh3": (PERIODS[2], "s"),
    "Adaptive Verner9": (PERIODS[8], "o"),
    "Adaptive Dopri8": (BLUE, "o"),
    "Adaptive Tsit5": (RED, "o"),
    "Adaptive Dopri5": (GREEN, "o"),
    "Adaptive Bosh3": (PERIODS[2], "o"),
    "Taylor, 8 steps": (PERIODS[4], "s"),
    "Taylor 12": (PERIODS[5], "^"),
    "Taylor 16": (ORANGE, "^"),
    "Taylor 20": (MORE_IMPACTS, "^"),
}
figure = Figure(figsize=(11, 8.6), layout="constrained")
panels = figure.subplots(2, len(DRIVES), squeeze=False)
for top, bottom, drive in zip(*panels, DRIVES, strict=True):
    rows, about = results[drive]
    for family in dict.fromkeys(row.choice.family for row in rows):
        mine = [row for row in rows if row.choice.family == family]
        color, marker = STYLE[family.removesuffix(", float32")]
        single = family.endswith("float32")
        look = {
            "color": color,
            "marker": marker,
            "ms": 11 if marker == "*" else 5,
            "mfc": "none" if single or marker == "o" else color,
            "ls": ":" if single else ("--" if marker == "o" else "-"),
            "lw": 1,
            "label": family,
        }
        time_ms = [1e3 * row.seconds for row in mine]
        top.loglog([max(row.errors["late95"], 1e-16) for row in mine], time_ms, **look)
        grid = [max(row.wrong, 0.3 / about["firm"]) for row in mine]  # NaN where not scanned
        bottom.loglog(grid, time_ms, **{**look, "ls": ""})
    top.set(
        title=f"{drive} drive",
        xlabel=f"error of the state after {MANY:,} cycles, 95 of 100 lanes (a, a ω, ω)",
        ylabel=f"{LANES} lanes, {TIMED} cycles: run time (ms)",
    )
    bottom.set(
        xlabel="share of regimes labelled wrongly (left edge: none)",
        ylabel=f"{LANES} lanes, {TIMED} cycles: run time (ms)",
    )
    for ax in (top, bottom):
        ax.grid(alpha=0.3)
figure.legend(
    handles=panels[0, 0].get_legend_handles_labels()[0],
    loc="outside lower center",
    ncols=5,
    fontsize=8,
)
numbers = {
    f"{row.choice.name}: median error of the state, 20 cycles, ideal drive": row.errors["state"]
    for row in results["ideal"][0]
    if row.choice.name == fixed("Verner9", 10).name
}
if not QUICK:
    keep(HERE, "speed_accuracy", report, numbers, figure)
