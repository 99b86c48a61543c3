"""A store recognizes the user's functions and classes by their source."""

import functools
import sys

import equinox as eqx
import jax
import pytest
import vi_jax as vi
from vi_jax.scans.program import Custom
from vi_jax.scans.store import UNVERIFIABLE, source_of

SOURCE = """
import vi_jax as vi

FACTOR = 2.0

def measure(scene, run, power=2):
    return {"depth": (FACTOR * run.y_min[-1]) ** power}

def maker(offset):
    return lambda scene, run: {"depth": run.y_min[-1] + offset}

class Depth(vi.AbstractMeasure):
    power: float = 2.0

    def __call__(self, scene, run):
        return {"depth": run.y_min[-1]}

class Deeper(Depth):
    pass

class Ball(vi.AbstractMachine):
    law: object
    cycle = 1.0

    def field(self, s, state):
        return vi.OscillatorState(state.V, -9.81)
"""


@pytest.fixture
def sources_of(tmp_path, monkeypatch):
    def found(source, folder):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "study.py").write_text(source)
        with monkeypatch.context() as patched:
            patched.syspath_prepend(tmp_path / folder)
            patched.delitem(sys.modules, "study", raising=False)
            import study  # pyright: ignore[reportMissingImports]

            things = {
                "measure": Custom(study.measure),
                "partial": functools.partial(study.measure, power=3),
                "compiled": eqx.filter_jit(jax.jit(study.measure)),
                "closure": study.maker(float(folder == "after")),
                "class": study.Deeper(),
                "machine": study.Ball(law=None),
                "law": vi.RigidStop(1.0, study.measure),
            }
            return {name: source_of(thing) for name, thing in things.items()}

    return found


MEASURES = {"measure", "partial", "compiled", "law"}


@pytest.mark.parametrize(
    "old, new, changed",
    [
        ("FACTOR = 2.0", "FACTOR = 3.0", set()),  # what a function reads needs a tag
        ("power=2)", "power=3)", MEASURES),
        ("-9.81", "-9.82", {"machine"}),
        ("power: float = 2.0", "power: float = 3.0", {"class"}),
    ],
)
def test_changes_of_source_change_the_identity(sources_of, old, new, changed):
    before, after = sources_of(SOURCE, "before"), sources_of(SOURCE.replace(old, new), "after")
    assert not any(one.startswith(UNVERIFIABLE) for one in before.values()), before
    changed_here = {name for name in before if before[name] != after[name]}
    assert changed_here == {*changed, "closure"}


def test_libraries_count_by_name_and_code_without_source_is_unverifiable():
    scene = vi.Scene.ideal(frequency_ratio=0.9)
    assert source_of(scene) == source_of(eqx.tree_at(lambda s: s.damping_ratio, scene, 0.1))
    assert source_of(vi.ExactFlight()) != source_of(vi.FixedStep())
    typed: dict = {}
    exec("def measure(scene, run): return {}", typed)
    for thing in (typed["measure"], Custom(typed["measure"])):
        assert source_of(thing).startswith(UNVERIFIABLE)
