"""Names of JAX and Equinox that lanes use, but that no public interface guarantees."""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from jax.ad_checkpoint import checkpoint_name
from jax.extend.core import Primitive, primitives
from jax.interpreters import mlir, partial_eval
from vi_jax import _programs, lanes
from vi_jax.lanes import _primitive
from vi_jax.lanes._array_rules import STRUCTURAL
from vi_jax.lanes._operations import ELEMENTWISE

# Primitives of this package, and those of JAX that are not public or not in all its versions.
OWN = {"sincos", "pin", "quotient", "weighted", "weighted_quotient", "weighted_sum", "weighted_dot"}
ELSEWHERE = {"copy_p", "pvary", "reshard", "expand_dims", "empty2", "stack", "unstack"}


def test_all_rules_have_a_primitive():
    there = {x.name for m in (primitives, jax.lax) for x in vars(m).values()
             if isinstance(x, Primitive)}  # fmt: skip
    gone = {*ELEMENTWISE, *STRUCTURAL} - there - OWN - ELSEWHERE
    assert not gone, f"JAX has no primitives {gone}: rename their rules (_operations.py)"


def test_the_results_of_checkpoint_policies():
    policy = jax.checkpoint_policies.save_and_offload_only_these_names(
        names_which_can_be_saved=["a"], names_which_can_be_offloaded=[],
        offload_src="device", offload_dst="pinned_host",
    )  # fmt: skip
    (eqn,) = jax.make_jaxpr(lambda x: checkpoint_name(x, "a"))(1.0).eqns
    message = "JAX says in another way that a value is saved: see `_saved` (_primitive.py)"
    assert _primitive._saved(policy(eqn.primitive, name="a")), message
    assert not _primitive._saved(policy(eqn.primitive, name="b")), message
    assert _primitive._saved(jax.checkpoint_policies.everything_saveable(eqn.primitive)), message


def test_the_arguments_of_a_partial_evaluation_rule(monkeypatch):
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


def test_the_names_of_settings():
    for name in ("compilation_cache_dir", "enable_compilation_cache", "enable_x64"):
        assert hasattr(jax.config, f"jax_{name}"), f"no setting {name} (_code.py, loop.py)"


def test_the_error_message_for_inner_compiler_options():
    inner = jax.jit(jnp.sin, compiler_options=_programs.PLAIN)
    with pytest.raises(ValueError) as caught:
        jax.jit(lambda x: inner(x))(1.0)
    assert "compiler_options" in str(caught.value), "see `CompiledFunction` (_programs.py)"


def test_programs_of_equinox_can_be_dropped():
    cached = getattr(eqx.filter_jit(jnp.sin), "_cached", None)
    message = "`CompiledFunction.drop` (_programs.py) would clear all of JAX's caches each time"
    assert hasattr(cached, "clear_cache"), message
