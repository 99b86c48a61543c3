"""The identity of a function or object changes with its source or content."""

import functools
import subprocess
import sys
import threading

import equinox as eqx
import jax
import pytest
import vi_jax as vi
from vi_jax.scans.store import UNVERIFIABLE, identity

# A user's module: a global number, a helper, a closure, a default value, classes.
SOURCE = """
import functools
import equinox as eqx
import jax
import jax.numpy as jnp
import vi_jax as vi

FACTOR = 2.0

def helper(x):
    return FACTOR * x if "a" in {"a", "b", "c"} else x

def measure(scene, run, power=2):
    return {"depth": helper(run.y_min[-1]) ** power}

def maker(offset):
    def machine(zeta):
        return vi.Scene.ideal(frequency_ratio=zeta + offset)
    return machine

class Depth(vi.AbstractMeasure):
    power: float = 2.0

    def __call__(self, scene, run):
        return {"depth": self.scaled(run.y_min[-1])}

    def scaled(self, x):
        return helper(x)

class Ball(vi.AbstractMachine):
    cycle: float = 1.0
    contacts = (vi.RigidStop(3.0, 0.8), vi.DryFriction(lambda speed: 0.1, on="V"))
    scales = {"V": jnp.array([1.0, 7.0])}

    def field(self, s, state):
        return vi.OscillatorState(state.V, -9.81)

class Plain:
    def __init__(self):
        self.gain = 1.5

    def __call__(self, scene, run):
        return {"depth": self.gain * run.y_min[-1]}
"""
THINGS = {
    "measure": "measure", "lambda": "(\n    lambda scene, run: {'depth': helper(run.y_min[-1])}\n)",
    "partial": "functools.partial(measure, power=3)", "compiled": "jax.jit(measure)",
    "filtered": "eqx.filter_jit(measure)", "mapped": "jax.vmap(measure)", "closure": "maker(0.1)",
    "module": "Depth()", "scene": "Ball()", "object": "Plain()",
}  # fmt: skip
LIST = "\nTHINGS = {" + ",\n".join(f"{name!r}: {text}" for name, text in THINGS.items()) + "}\n"


@pytest.fixture
def identities(tmp_path, monkeypatch):
    def found(source, folder):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "study.py").write_text(source + LIST)
        with monkeypatch.context() as patched:
            patched.syspath_prepend(tmp_path / folder)
            patched.delitem(sys.modules, "study", raising=False)
            import study

            return {name: identity(thing) for name, thing in study.THINGS.items()}

    return found


MEASURES = {"measure", "compiled", "filtered", "mapped", "partial"}


@pytest.mark.parametrize(
    "old, new, changed",
    [
        ("FACTOR = 2.0", "FACTOR = 2.0  # unit: a", set()), ("power=2)", "power=3)", MEASURES),
        ("maker(offset):\n", "maker(offset):\n    offset = 2 * offset\n", {"closure"}),
        ("FACTOR = 2.0", "FACTOR = 2.0\ngain = 5.0  # not the attribute", set()),
        ("-9.81", "-9.82", {"scene"}), ("Stop(3.0", "Stop(3.1", {"scene"}),
        ("speed: 0.1", "speed: 0.2", {"scene"}), ("1.0, 7.0", "1.0, 8.0", {"scene"}),
        ("self.gain = 1.5", "self.gain = 1.6", {"object"}),
        ('return {"depth": self.scaled', 'return {"deep": self.scaled', {"module"}),
        ("power: float = 2.0", "power: float = 3.0", {"module"}),
        ("FACTOR = 2.0", "FACTOR = 3.0", {*MEASURES, "lambda", "module"}),
    ],
)  # fmt: skip
def test_changes_of_source_change_the_identity(identities, old, new, changed):
    assert old in SOURCE
    before, after = (identities(SOURCE, "before"), identities(SOURCE.replace(old, new), "after"))
    assert not any(one.startswith(UNVERIFIABLE) for one in before.values()), before
    assert {name for name in before if before[name] != after[name]} == changed


@pytest.mark.parametrize(
    ("study", "changed"),
    [
        ("import parts\ndef measure(m, run):\n    return parts.gain(run)\n", True),
        ("import parts\ndef measure(m, run):\n    return parts.other(run)\n", False),
        ("import parts as p\ndef measure(m, run):\n    return (lambda: p.gain(run))()\n", True),
        ("def measure(m, run):\n    import parts\n    return parts.gain(run)\n", True),
        ("from parts import gain\ndef measure(m, run):\n    return [*map(gain, run)]\n", True),
    ],
)  # fmt: skip
def test_helpers_in_modules_change_the_identity(tmp_path, monkeypatch, study, changed):
    helpers = "FACTOR = 2\ndef gain(x):\n    return FACTOR * x\ndef other(x):\n    return x\n"
    found = []
    for factor in "23":
        folder = tmp_path / factor
        folder.mkdir()
        (folder / "parts.py").write_text(helpers.replace("2", factor))
        (folder / "work.py").write_text(study)
        with monkeypatch.context() as patched:
            patched.syspath_prepend(folder)
            for name in ("parts", "work"):
                patched.delitem(sys.modules, name, raising=False)
            import parts  # noqa: F401
            import work

            found.append(identity(work.measure))
    assert not any(one.startswith(UNVERIFIABLE) for one in found)
    assert (found[0] != found[1]) == changed


@pytest.mark.slow
def test_the_identity_does_not_depend_on_the_process(tmp_path):
    """The order of sets differs between the processes."""
    (tmp_path / "study.py").write_text(SOURCE + LIST)
    script = tmp_path / "tell.py"
    script.write_text(
        "from study import THINGS\nfrom vi_jax.scans.store import identity\n"
        "print([identity(thing) for thing in THINGS.values()])\n"
    )
    described = [
        subprocess.run(
            [sys.executable, str(script)],
            env={"PYTHONHASHSEED": seed, "PYTHONPATH": ":".join(filter(None, sys.path))},
            capture_output=True, text=True, check=True,
        ).stdout
        for seed in ("1", "2")
    ]  # fmt: skip
    assert described[0] == described[1] and described[0].count(",") == len(THINGS) - 1


def test_identities_of_the_librarys_objects():
    scene = vi.Scene.ideal(frequency_ratio=0.9)
    other = eqx.tree_at(lambda s: s.drive.frequency_ratio, scene, 0.91)
    assert identity(scene) == identity(vi.Scene.ideal(frequency_ratio=0.9)) != identity(other)
    methods = [vi.ExactFlight(), vi.FixedStep(), vi.FixedStep(steps_per_cycle=24), vi.Adaptive()]
    assert len({identity(method) for method in methods}) == 4


def test_recursive_functions_are_verifiable_and_opaque_objects_are_not():
    def ring(n):
        return ring(n - 1) if n else 0

    assert not identity(ring).startswith(UNVERIFIABLE)

    lock = threading.Lock()

    def hiding(scene, run):
        return {"held": lock.locked()}

    typed: dict = {}
    exec("def measure(scene, run): return {}", typed)
    for thing in (
        hiding,
        functools.partial(hiding, 1),
        jax.jit(hiding),
        (x for x in "ab"),
        typed["measure"],
    ):
        assert identity(thing).startswith(UNVERIFIABLE)


PAIR = [lambda x: 0.1 * x, lambda x: 0.2 * x]


def test_functions_on_one_line_differ():
    assert identity(PAIR[0]) != identity(PAIR[1])
