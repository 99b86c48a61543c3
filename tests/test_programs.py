"""Compiled programs are dropped before the process reaches Linux's limit of memory maps."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax import _programs
from vi_jax.lanes import _primitive

SCENE = vi.Scene.ideal(frequency_ratio=0.9, gap=None)


def section(cycles):
    with vi.backend("xla"):  # its programs take hundreds of maps
        return vi.simulate(SCENE, SCENE.start(Y=0.1), cycles, record="sections").sections.Y


@pytest.fixture
def watch(monkeypatch):
    """Return a watch that checks at every call."""
    watch = _programs._Watch()
    monkeypatch.setattr(_programs, "_watch", watch)
    monkeypatch.setattr(_programs, "_SELDOM", 0)
    monkeypatch.setattr(_programs, "_PAUSE", 0)
    # Collection takes seconds after other tests; `maps_used` is replaced anyway.
    monkeypatch.setattr(_programs.gc, "collect", lambda: 0)
    return watch


@pytest.mark.slow
def test_the_program_called_last_is_dropped_last(watch, monkeypatch):
    dropped = []

    def program(name):
        made = _programs.CompiledFunction(lambda x: x + 1)
        monkeypatch.setattr(made, "drop", lambda: dropped.append(name))
        return made

    a, b, c = (program(name) for name in "abc")
    for each in (a, b, c, a):
        each(jnp.zeros(3))
    used = iter([900, 800, 300, 300])
    monkeypatch.setattr(_programs, "maps_granted", lambda: 1000)
    monkeypatch.setattr(_programs, "maps_used", lambda: next(used))
    with pytest.warns(RuntimeWarning, match=r"used 900 of the 1,000 .* which leaves 300[.]$"):
        a(jnp.zeros(3))
    assert dropped == ["b", "c"]
    used = iter([900, 900, 900, 900])
    with pytest.warns(RuntimeWarning, match=r"call `jax.clear_caches\(\)` now and then"):
        a(jnp.zeros(3))


def test_systems_without_memory_maps_give_no_warning(watch, monkeypatch, tmp_path):
    monkeypatch.setattr(_programs, "_MAPS", tmp_path / "maps")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        section(1)


class Table(vi.AbstractMachine):
    """An oscillator driven by a cosine, or by a table plus a small term without a vector form."""

    looked_up: bool
    contacts: tuple = (vi.RigidStop(1.5, 0.7),)
    cycle = 2 * np.pi

    def field(self, s, state):
        push = jnp.cos(s)
        if self.looked_up:
            push = jnp.interp(s, jnp.linspace(0, 7, 99), jnp.cos(jnp.linspace(0, 7, 99)))
            push = push + 1e-6 * jax.scipy.special.erfinv(0.5 * jnp.sin(s))
        return vi.OscillatorState(state.V, push - 0.1 * state.V - 0.5 * state.Y)


@pytest.mark.slow
def test_fields_without_a_vector_form_are_compiled_in_full(monkeypatch):
    """A program is compiled quickly only if XLA does not compile its loops."""
    _primitive._warn.cache_clear()  # the warning may have been given in this process
    made = []
    original = _programs.CompiledFunction._quick.func
    monkeypatch.setattr(
        _programs.CompiledFunction,
        "_quick",
        property(lambda self: made.append(self) or original(self)),
    )
    zero = jnp.zeros(())
    function = _programs.CompiledFunction(
        lambda scene: vi.simulate(scene, vi.OscillatorState(zero, zero), 3, method="draft").last
    )
    last = function(Table(False))
    assert made == [function] and not function._never_quick
    with pytest.warns(UserWarning, match="slower backend"):
        there = function(Table(True))
    assert made == 2 * [function] and len(function._never_quick) == 1
    function(Table(False))  # this one stays quick
    assert made == 3 * [function]
    function(Table(True))
    assert made == 3 * [function]
    np.testing.assert_allclose(there.Y, last.Y, atol=1e-3)


def test_a_compiled_function_works_within_other_programs():
    function = _programs.CompiledFunction(lambda x: jnp.sin(x) * x)
    x = jnp.asarray(0.7)
    alone = function(x)
    within = jax.jit(lambda y: function(x) + 0 * y)(x)  # its argument is concrete there
    np.testing.assert_allclose([within, jax.jit(function)(x)], alone, rtol=1e-15)
    np.testing.assert_allclose(jax.vmap(function)(jnp.stack([x, x])), alone, rtol=1e-15)
    np.testing.assert_allclose(jax.grad(function)(x), jnp.sin(x) + x * jnp.cos(x), rtol=1e-15)


def test_compiler_options_unknown_to_xla_are_left_out():
    known = _programs._supported(_programs.PLAIN)  # none since JAX 0.12
    options = {"xla_no_such_option": 1, **_programs.PLAIN}
    assert _programs._supported(options) == known
    assert float(_programs.CompiledFunction(lambda x: x + 1, options)(jnp.asarray(1.0))) == 2.0


@pytest.mark.parametrize("derivative", [jax.jacfwd, pytest.param(jax.grad, marks=pytest.mark.slow)])
def test_a_machine_may_close_over_differentiated_numbers(derivative):
    """The class is defined in a function of its parameters, and its guard computes with them."""

    def last(numbers):
        class Shaken(vi.AbstractMachine):
            contacts: tuple = (vi.RigidStop(0.8, 0.7),)
            cycle: float = 2 * np.pi

            @property
            def events(self):
                pushed = lambda machine, s, x: vi.OscillatorState(x.Y, x.V + 0.1 * numbers[1])
                return vi.Reset(lambda machine, s, x: x.Y + jnp.sin(numbers[0]) / 9, pushed)

            def field(self, s, state):
                pull = numbers[1] * jnp.cos(s) - state.Y * numbers[0]
                return vi.OscillatorState(state.V, pull - 0.1 * state.V)

        start = vi.OscillatorState(numbers[2], numbers[3])
        run = vi.simulate(Shaken(), start, 2, method=vi.Adaptive(rtol=1e-12))
        return run.last.Y + run.y_min[0]

    at = jnp.array([1.2, 1.5, 0.1, 0.2])
    found = derivative(last)(at)
    steps = 1e-5 * jnp.eye(4)
    up, down = jax.jit(jax.vmap(jax.vmap(last)))(jnp.stack([at + steps, at - steps]))
    truth = (up - down) / 2e-5
    np.testing.assert_allclose(found, truth, rtol=1e-7)


@pytest.mark.slow
def test_a_law_may_close_over_a_differentiated_number():
    """Without `jit` too, where no argument is traced."""

    def speed(k):
        stop = vi.RigidStop(0.4, lambda approach: k + 0 * approach)
        scene = vi.Scene(oscillator=vi.Oscillator(0.1), drive=vi.IdealDrive(0.9), stops=(stop,))
        return vi.simulate(scene, scene.start(), 3, method=vi.ExactFlight()).last.V

    slope = (speed(0.6 + 1e-6) - speed(0.6 - 1e-6)) / 2e-6
    for along in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(along(speed)(0.6), slope, rtol=1e-6)
        np.testing.assert_allclose(jax.jit(along(speed))(0.6), slope, rtol=1e-6)
