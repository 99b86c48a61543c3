"""Invalid calls, each with a part of its error message. The script prints all that deviate.

It runs in a separate process, since its calls fill caches that other tests would share."""

import datetime
import importlib
import json
import sys

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)
import vi_jax as vi

SCENE = vi.Scene.ideal(frequency_ratio=0.9)
START = SCENE.start(Y=1.6, V=-1.9)
ZETA = "drive.frequency_ratio"
AXES = {ZETA: [0.8, 0.9]}
REGION = {"start.Y": (0.0, 1.0)}


class Own(vi.AbstractMachine):
    """A free oscillator."""

    cycle: float = 1.0

    def field(self, s, state):
        """Y'' = -Y."""
        return vi.OscillatorState(state.V, -state.Y)


def simulate(start=START, cycles=2, **options):
    return lambda: vi.simulate(SCENE, start, cycles, **options)


def scan(axes=AXES, scene=SCENE, **options):
    return lambda: vi.scan(scene, axes, **{"measure": "extremes", "cycles": 4, **options})


def measured(**numbers):
    return scan(measure=lambda scene, run: numbers)


def sweep(scene=SCENE, values=(0.8, 0.9), parameter=ZETA, **options):
    return lambda: vi.sweep(scene, parameter, values, **options)


def basins(region=REGION, **options):
    return lambda: vi.basins(SCENE, region, **options)


def built(**parts):
    usual = {"damping_ratio": 0.1, "drive": vi.IdealDrive(0.9)}
    return lambda: vi.Scene(**{**usual, **parts})


def orbit(guess=START, **options):
    return lambda: vi.find_orbit(SCENE, guess, 2, **options)


REAL = "must be a real number"
ROW = "must be one row of finite real numbers"
CALLS = {
    "cycles=0": (simulate(cycles=0), "`cycles` must be at least 1, but got 0"),
    "cycles=2.5": (simulate(cycles=2.5), "`cycles` must be an integer, but got 2.5"),
    "record='all'": (simulate(record="all"), "`record` must be one of 'motion', 'sections'"),
    "NaN in a start": (simulate(vi.OscillatorState(np.nan, 0.0)), "must be finite"),
    "machine and start swapped": (lambda: vi.simulate(START, SCENE, 2), "`machine` must be a"),
    "a list as start": (simulate([0.0, 0.0]), "`start` must be a state of Y, V for"),
    **{f"{x!r} in {who}": (call(vi.OscillatorState(x, 0.0)), "must hold real numbers, but its Y")
       for x in (1j, jnp.array(True), "a")
       for who, call in {
           "a start": simulate, "a guess": orbit,
           "a sweep's start": lambda start: sweep(start=start),
           "a scan's start": lambda start: scan(start=start),
           "an own scene's start": lambda start: lambda: vi.simulate(Own(), start, 2)}.items()},
    "a list for an own scene": (lambda: vi.simulate(Own(), [0.0], 2), "`start` must be a state"),
    "a text for an own scene": (lambda: vi.simulate(Own(), "ab", 2), "`start` must hold real"),
    "a list as a scan's start": (scan(start=[0.0]), "`start` must be a state of Y, V for"),
    "a text as a sweep's start": (sweep(start="ab"), "`start` must be a state of Y, V for"),
    "cycles=2*10**9": (simulate(cycles=2 * 10**9), "results that fit into the memory"),
    "samples=10**12": (simulate(samples=10**12), "`samples` must be at most"),
    "a grid": (scan({ZETA: np.linspace(0.5, 1, 10**6), "start.Y": np.linspace(0, 1, 10**6)}),
               "`axes` must ask for results that fit into the memory"),
    "flags": (simulate(estimate="no"), "`estimate` must be True or False"),
    **{f"axis of {x!r}": (scan({ZETA: x}), ROW) for x in (
        ["0.8"], [True], np.array([True]), [True, 0.5], [1 + 0j], [None], [datetime.date.max],
        np.array(["2020-01-01"], "M8[D]"), [[0.8]], [np.nan], "0.8", 0.8, [])},
    **{f"values of {x!r}": (sweep(values=x), "Argument `values` must be") for x in (
        ["0.8"], [True], [1j], np.array(["2020-01-01"], "M8[D]"), [np.nan], 0.8)},
    **{f"tolerance={x!r}": (sweep(tolerance=x), "Argument `tolerance` must be") for x in (
        np.nan, np.float32("nan"), "1", True, 1j, 0.0)},
    **{f"rtol={x!r}": (lambda x=x: vi.Adaptive(rtol=x), f"`rtol` {REAL}") for x in (
        1e-3 + 0j, True, "a", None)},
    **{f"apart={x!r}": (basins(apart=x), "Argument `apart` must be") for x in (
        0, -1, np.nan, "a", None, True)},
    "a region of no part": (basins({"start.Z": (0.0, 1.0)}), "got 'start.Z'; near names: start.Y"),
    "a region of texts": (basins({"start.Y": ("0", "1")}), ROW),
    "crank='cosine'": (lambda: vi.Scene.ideal(frequency_ratio=0.9, crank="cosine"),
                       "`crank` must be a `CosineCrank()`"),
    "damping_ratio='0.1'": (built(damping_ratio="0.1"), "`damping_ratio` must be a real number"),
    "one stop": (built(stops=vi.RigidStop(1.0, 0.5)), "`stops` must be a tuple"),
    **{f"frequency_ratio={x!r}": (
        lambda x=x: vi.Scene.ideal(frequency_ratio=x), "Argument `frequency_ratio` must be") for x
       in (1j, True, jnp.array(True), np.str_("0.9"), ["0.9"], np.datetime64("2020"), 10**400)},
    "Y='1'": (lambda: SCENE.start(Y="1"), f"`Y` {REAL}"),
    **{f"Newton(tolerance={x!r})": (
        lambda x=x: vi.Newton(tolerance=x), "Argument `tolerance` must be") for x in (
        np.nan, True, 1j, "a", 0.0)},
    "root_finder=Newton": (orbit(root_finder=vi.Newton), "`root_finder` must be `Newton(...)`"),
    "boundary('x')": (lambda: vi.boundary("x", parameter="stops.0.gap", bounds=((0, 1), (0, 1))),
                      "`point` must be a `Point`"),
    "a list as a guess of an own scene": (lambda: vi.find_orbit(Own(), [0.9]),
                                          "`guess` must be a state"),
    "a list as a guess of a structure": (lambda: vi.find_orbit(vi.machines.Beam(), [0.9]),
                                         "`guess` must be a state of a Beam"),
    "a table of guesses": (orbit(vi.OscillatorState(np.zeros((2, 3)), np.zeros((2, 3)))),
                           "`guess` must be one state, or several along one axis"),
    "section='pi'": (orbit(section="pi"), f"`section` {REAL}"),
    "cluster='tcp://x'": (scan(cluster="tcp://x"), "`cluster` must be a `dask"),
    "a scene of 5": (scan({"zeta": [1.0]}, lambda zeta: 5), "but it returned 5"),
    "a scene of another name": (scan({"zeta": [1.0]}, lambda xi: SCENE), "missing a required"),
    "an own scene without start": (scan({"x": [1.0]}, lambda x: Own()), "`start` is missing"),
    "a measure of 5": (scan(measure=lambda scene, run: 5), "must return a mapping of names"),
    "a measure of texts": (measured(a="b"), "its 'a' is 'b'"),
    "a measure named result": (measured(result=1.0), "must not return 'result'"),
    "a measure named like an axis": (measured(**{ZETA: 1.0}), "another name than the axis"),
    "a dimension named like an axis": (
        scan({"cycle": [0.8, 0.9]}, lambda cycle: SCENE, measure="sections", cycles=16),
        "another name than the axis 'cycle'"),
    "two measures of one name": (
        scan(measure=("extremes", lambda scene, run: {"y_min": 1.0})), "must not return 'y_min'"),
    "a measure with a path": (measured(**{"a/b": 1.0}), "must name its numbers by words"),
    "derivatives=5": (scan(derivatives=5), "`derivatives` must be a tuple"),
    "store=5": (scan(store=5), "`store` must be a path"),
}  # fmt: skip


def work(*arguments, **options):
    raise RuntimeError("work began")


if __name__ == "__main__":
    for module, name in (
        ("scans._scan", "run_blocks"),
        ("scans._sweep", "_sweep"),
        ("orbit.find", "_find"),
        ("flow._simulate", "_simulate"),
    ):
        setattr(importlib.import_module(f"vi_jax.{module}"), name, work)
    wrong = {}
    for what, (call, words) in CALLS.items():
        try:
            found = f"accepted: {call()!r}"
        except Exception as error:
            found = f"{type(error).__name__}: {error}"
        refused = found.startswith(("ValueError", "TypeError")) and words in found
        if not refused:
            wrong[what] = found[:300]
    json.dump({"calls": len(CALLS), "wrong": wrong}, sys.stdout)
