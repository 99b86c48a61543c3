"""Programs serve other parameters and later processes, but never another machine."""

import importlib
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.machine import by_name, with_leaf

NUMBERS = [
    *map(float, np.linspace(1.05, 1.15, 7)), np.float64(1.16), jnp.asarray(1.17), np.array(1.18),
]  # fmt: skip


class Law(eqx.Module):
    """A restitution that falls with speed."""

    slope: float

    def __call__(self, approach):
        return 0.8 / (1 + self.slope * approach)


class Shaken(vi.AbstractMachine):
    """A body on a spring under several harmonics; the field loops over their integer number."""

    shaking: jax.Array | float = 1.0
    law: Any = 0.5
    harmonics: int = 2
    softening: bool = False

    @property
    def contacts(self):
        return (vi.RigidStop(1.5, self.law),)

    cycle = 2 * np.pi

    def field(self, s, state):
        push = sum(self.shaking * jnp.cos(n * s) / n for n in range(1, 1 + self.harmonics))
        spring = 1.0 if self.softening else 2.0
        return vi.OscillatorState(state.V, push - 0.3 * state.V - spring * state.Y)

    def start(self):
        return vi.OscillatorState(jnp.asarray(0.1), jnp.asarray(0.0))


MACHINES: dict[str, Callable[[Any], vi.AbstractMachine]] = {
    "own": lambda x: Shaken(shaking=x),
    "law": lambda x: Shaken(shaking=3.0, law=Law(x)),
}


@pytest.fixture
def traces(monkeypatch):
    """Count how often each function is traced."""
    counts = {"simulate": 0, "find_orbit": 0}

    def counted(verb, path, name):
        module = importlib.import_module(path)
        function = getattr(module, name)

        def wrapper(*args, **options):
            counts[verb] += 1
            return function(*args, **options)

        monkeypatch.setattr(module, name, wrapper)

    counted("simulate", "vi_jax.flow._simulate", "collect")
    counted("find_orbit", "vi_jax.orbit.find", "_find_one")
    return counts


@pytest.mark.parametrize("name", ["own", "law"])
def test_ten_values_compile_one_program(traces, name):
    """`with_leaf` reuses the program, and equal parameters give the same motion."""
    cycles = 5 + sorted(MACHINES).index(name)  # no other test compiles this
    found = {}
    for x in NUMBERS:
        machine = MACHINES[name](x)
        found[float(x)] = vi.simulate(machine, machine.start(), cycles).last
    assert traces["simulate"] == 1
    first = MACHINES[name](1.0)
    other = by_name(MACHINES[name](2.0))
    (changed,) = (n for n, x in by_name(first).items() if float(x) != float(other[n]))
    again = vi.simulate(with_leaf(first, changed, 1.05), first.start(), cycles).last
    assert traces["simulate"] == 1
    np.testing.assert_array_equal(*map(jax.tree.leaves, (again, found[1.05])))
    assert len({float(jax.tree.leaves(x)[0]) for x in found.values()}) == len(NUMBERS)


def test_float_written_as_an_integer_is_not_truncated():
    machine = with_leaf(Shaken(shaking=1), "shaking", 1.5)
    same = replace(machine, shaking=1.5)
    a, b = (vi.simulate(m, m.start(), 11).last.Y for m in (machine, same))
    assert float(machine.shaking) == 1.5 and float(a) == float(b)


RUN = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
import vi_jax as vi

print(vi.keep_programs())
STIFFNESS = float(sys.argv[1])

class Body(vi.Mechanical):
    q = ("x",)
    cycle = 3.0

    def mass(self, q):
        return 1.0

    def force(self, t, q, v):
        return dict(x=-STIFFNESS * q.x)

print(float(vi.simulate(Body(), Body().at(x=1.0)).last.x))
"""


def test_a_changed_global_gives_the_new_motion_with_a_warm_cache(tmp_path):
    unset = ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS")
    environment = {k: x for k, x in os.environ.items() if k not in unset}
    environment |= {"XDG_CACHE_HOME": str(tmp_path), "JAX_PLATFORMS": "cpu"}

    def found(stiffness):
        command = [sys.executable, "-c", RUN, str(stiffness)]
        out = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        folder, x = out.stdout.split()
        assert folder == str(tmp_path / "vi_jax") and not out.stderr
        return float(x), {path for path in (tmp_path / "vi_jax").rglob("*") if path.is_file()}

    first, files = found(4.0)
    assert first == pytest.approx(0.9601702866503661, abs=1e-8)  # cos 6
    assert any(path.suffix == ".o" for path in files)
    second, more = found(1.0)
    assert second == pytest.approx(-0.9899924966004454, abs=1e-8) and more > files  # cos 3
    assert found(4.0) == (first, more)
