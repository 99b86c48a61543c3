"""What lanes take from JAX and Equinox by name: a test for each that no public module promises."""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from jax.ad_checkpoint import checkpoint_name
from jax.extend.core import ClosedJaxpr, Jaxpr, Primitive, primitives
from jax.interpreters import mlir, partial_eval
from vi_jax import _programs, lanes
from vi_jax.lanes import _primitive
from vi_jax.lanes._arrays import STRUCTURAL
from vi_jax.lanes._operations import ELEMENTWISE
from vi_jax.lanes._program import called, scan_counts

# Primitives of this package, and some that JAX has in no public module or had in earlier versions.
OWN = {"sincos", "pin", "quotient", "weighted", "weighted_quotient", "weighted_dot"}
ELSEWHERE = {"copy_p", "pvary", "reshard", "expand_dims", "empty2"}


def test_rules_are_written_for_primitives_that_there_are():
    there = {x.name for m in (primitives, jax.lax) for x in vars(m).values()
             if isinstance(x, Primitive)}  # fmt: skip
    gone = {*ELEMENTWISE, *STRUCTURAL} - there - OWN - ELSEWHERE
    assert not gone, f"JAX has no primitives {gone}: rename their rules (_operations.py)"


def by_vjp(x):
    function = jax.custom_vjp(jnp.sin)
    function.defvjp(lambda x: (jnp.sin(x), x), lambda x, g: (g * jnp.cos(x),))
    return function(x)


def by_jvp(x):
    function = jax.custom_jvp(jnp.sin)
    function.defjvps(lambda slope, out, x: slope * jnp.cos(x))
    return function(x)


@pytest.mark.parametrize("call", [jax.jit(jnp.sin), jax.checkpoint(jnp.sin), by_jvp, by_vjp])
def test_calls_are_known_by_their_names(call):
    (eqn,) = jax.make_jaxpr(call)(1.0).eqns
    name = eqn.primitive.name
    assert isinstance(called(eqn), Jaxpr | ClosedJaxpr), f"`called` (_program.py) lacks `{name}`"


LOOPS = {
    "cond": (lambda x: jax.lax.cond(x > 0, jnp.sin, jnp.cos, x), "branches"),
    "while": (
        lambda x: jax.lax.while_loop(lambda a: a < 5, lambda a: a * a, x),
        "cond_jaxpr cond_nconsts body_jaxpr body_nconsts",
    ),
    "scan": (
        lambda x: jax.lax.scan(lambda a, b: (a * b, a), x, jnp.arange(3.0))[0],
        "jaxpr length reverse",
    ),
}


@pytest.mark.parametrize("name", LOOPS)
def test_loops_and_branches_are_known_by_their_names(name):
    function, parameters = LOOPS[name]
    found = {e.primitive.name: e.params for e in jax.make_jaxpr(function)(1.0).eqns}
    assert name in found, f"JAX makes {[*found]} of `{name}` (_vector.py, _program.py)"
    gone = {*parameters.split()} - {*found[name]}
    assert not gone, f"`{name}` has no parameters {gone}: see `_equation` (_vector.py)"


def test_a_scan_says_what_it_carries():
    def loop(x, carried):
        turn = lambda a, row: ((a[0] * row + x[1], {"sum": a[1]["sum"] + row}), a[0])
        return jax.lax.scan(turn, carried, jnp.arange(3.0))

    numbers = (1.0, 2.0), (3.0, {"sum": 4.0})
    (eqn,) = (e for e in jax.make_jaxpr(loop)(*numbers).eqns if e.primitive.name == "scan")
    assert (*scan_counts(eqn.params), len(eqn.invars)) == (1, 2, 4)


def test_what_a_policy_of_checkpoint_says():
    policy = jax.checkpoint_policies.save_and_offload_only_these_names(
        names_which_can_be_saved=["a"], names_which_can_be_offloaded=[],
        offload_src="device", offload_dst="pinned_host",
    )  # fmt: skip
    (eqn,) = jax.make_jaxpr(lambda x: checkpoint_name(x, "a"))(1.0).eqns
    message = "JAX says in another way that a value is saved: see `_saved` (_primitive.py)"
    assert _primitive._saved(policy(eqn.primitive, name="a")), message
    assert not _primitive._saved(policy(eqn.primitive, name="b")), message
    assert _primitive._saved(jax.checkpoint_policies.everything_saveable(eqn.primitive)), message


def test_what_a_rule_for_partly_known_values_is_given(monkeypatch):
    gone, rule = [], _primitive._partially_known

    def spy(trace, *tracers, **parameters):
        gone.extend(["trace"] * (not hasattr(trace, "default_process_primitive")))
        gone.extend(x for x in tracers if not hasattr(x, "is_known"))
        gone.extend(x for x in tracers if not hasattr(x.pval, "get_known"))
        return rule(trace, *tracers, **parameters)

    rules = partial_eval.custom_partial_eval_rules
    monkeypatch.setitem(rules, _primitive.lanes_p, spy)  # pyright: ignore
    jax.vjp(lambda x: lanes.once(jnp.sin, x), 0.5)
    assert not gone, f"{gone} have other methods: see `_partially_known` (_primitive.py)"
    assert hasattr(mlir.ModuleContext, "add_keepalive"), "see `_lowered` (_primitive.py)"


def test_settings_are_known_by_their_names():
    for name in ("compilation_cache_dir", "enable_compilation_cache", "enable_x64"):
        assert hasattr(jax.config, f"jax_{name}"), f"no setting {name} (_code.py, _trace.py)"


def test_compiler_options_within_a_program_are_refused_in_these_words():
    inner = jax.jit(jnp.sin, compiler_options=_programs.PLAIN)
    with pytest.raises(ValueError) as caught:
        jax.jit(lambda x: inner(x))(1.0)
    assert "compiler_options" in str(caught.value), "see `CompiledFunction` (_programs.py)"


def test_what_equinox_compiled_can_be_dropped():
    cached = getattr(eqx.filter_jit(jnp.sin), "_cached", None)
    message = "`CompiledFunction.drop` (_programs.py) would clear all of JAX's caches each time"
    assert hasattr(cached, "clear_cache"), message
