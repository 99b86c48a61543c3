"""Ctrl-C interrupts lanes, and lanes that did not run raise an error."""

import functools
import gc
import signal
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax._messages import at_work
from vi_jax.lanes import runtime

SCENE = vi.Scene.ideal(frequency_ratio=0.9)
WAYS = "simulate", "jit", "vmap", "grad", "sweep"


def test_the_number_of_threads_is_checked():
    for number in (0, -1, 1025, 10**30):
        with pytest.raises(ValueError, match="`number` must be from 1 to 1024, but got"):
            vi.threads(number)
    for number in (False, True, "a", 1.5, None, jnp.asarray(2)):
        with pytest.raises(TypeError, match="`number` must be an integer, but got"):
            vi.threads(number)


@pytest.mark.slow
def test_two_threads_may_use_lanes_first_at_once():
    """Only one handler may be created for XLA, by either thread."""
    script = Path(__file__).with_name("first_use.py")
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["1"]


def test_lanes_that_did_not_run_raise(monkeypatch):
    """Their results would be uninitialised memory."""
    lanes = jax.jit(jax.vmap(lambda V: vi.simulate(SCENE, SCENE.start(V=V), 3).impacts))
    starts = jnp.linspace(0.0, 0.5, 24)
    whole = np.asarray(lanes(starts))
    with vi.threads(np.int64(2)):
        np.testing.assert_array_equal(lanes(starts), whole)
    monkeypatch.setattr(runtime, "thread_count", lambda: 0)
    with pytest.raises(Exception, match="Not all lanes were run"):
        np.asarray(lanes(starts))
    monkeypatch.undo()
    turn = runtime.KernelCall._run_here
    monkeypatch.setattr(
        runtime.KernelCall, "_run_here", lambda self: setattr(self.stop, "value", 1) or turn(self)
    )
    with pytest.raises(Exception, match="interrupted before all of them had ended"):
        np.asarray(lanes(starts))


class Collected(vi.AbstractMachine):
    """A machine whose field runs the garbage collector when it is traced."""

    cycle: float = 1.0

    def field(self, s, state):
        gc.collect(0)
        return vi.OscillatorState(state.V, -state.Y)

    def start(self):
        return vi.OscillatorState(jnp.asarray(1.0), jnp.asarray(0.0))


@pytest.fixture
def interrupt_in_collection():
    """Return a function that sends Ctrl-C in a garbage collection, where Python drops it."""
    waiting = []

    def callback(phase, _):
        if waiting:
            waiting.clear()
            signal.raise_signal(signal.SIGINT)

    gc.callbacks.append(callback)
    yield lambda: waiting.append(True)
    gc.callbacks.remove(callback)


@pytest.mark.slow
def test_interrupts_within_the_garbage_collector_are_kept(interrupt_in_collection):
    """The interrupt comes during tracing, before a progress report, or before lanes run."""
    hook = sys.unraisablehook
    motion = jax.jit(lambda settle: vi.simulate(SCENE, SCENE.start(), 1, settle=settle).last.Y)
    motion(1)
    interrupt_in_collection()
    with pytest.raises(KeyboardInterrupt):
        vi.simulate(Collected(), Collected().start(), 1, settle=10**8)
    for more in (None, lambda: motion(10**8).block_until_ready()):
        with (
            pytest.raises(vi.Interrupted) as caught,
            at_work("", lambda: 7, progress=False) as tell,
        ):
            tell(1)
            interrupt_in_collection()
            gc.collect()
            (more or functools.partial(tell, 1))()
        assert caught.value.partial == 7
    assert sys.unraisablehook is hook


def _printed(script):
    done = subprocess.run(
        [sys.executable, Path(__file__).parent / script],
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    return done


@pytest.mark.slow
def test_each_way_of_calling_a_kernel_is_interruptible():
    done = _printed("interrupted_ways.py")
    assert "swallowed" not in done.stderr
    for line, way in zip(done.stdout.splitlines(), WAYS, strict=True):
        name, *seconds = line.split()
        assert name == way and all(float(s) < 2 for s in seconds), line


@pytest.mark.slow
def test_a_loop_receives_every_interrupt_and_stays_correct():
    """Interrupts come at random times, also while XLA calls Python."""
    done = _printed("interrupted_loop.py")
    words = done.stdout.split()
    assert words[2:] == ["lost", "0", "wrong", "0", "errors", "0"] and int(words[1]) >= 120, words
