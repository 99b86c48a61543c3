"""`Unrolled` takes the same steps as the solver that it wraps."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import vi_jax as vi

SOLVERS = [diffrax.Tsit5(), diffrax.Dopri5(), diffrax.Dopri8(), diffrax.Bosh3(), diffrax.Heun()]


def field(t, y, args):
    return {"x": y["v"], "v": jnp.cos(t) - y["x"] ** 3 - args * y["v"]}


TERM = diffrax.ODETerm(field)
START = {"x": jnp.asarray(0.3), "v": jnp.asarray(-0.7)}


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda x: type(x).__name__)
def test_step_equals_that_of_diffrax(solver):
    args = 0.1
    hidden = solver.init(TERM, 0.2, 0.5, START, args)
    original = solver.step(TERM, 0.2, 0.5, START, args, hidden, False)
    unrolled = vi.Unrolled(solver).step(TERM, 0.2, 0.5, START, args, None, False)
    for mine, theirs in zip(unrolled[:2], original[:2], strict=True):
        for name in START:
            np.testing.assert_allclose(mine[name], theirs[name], rtol=1e-14, atol=1e-16)
    mine = vi.Unrolled(solver).interpolation_cls(t0=0.2, t1=0.5, **unrolled[2])
    theirs = solver.interpolation_cls(t0=0.2, t1=0.5, **original[2])
    for t in (0.23, 0.4, 0.5):
        a, b = mine.evaluate(t), theirs.evaluate(t)
        np.testing.assert_allclose(a["x"], b["x"], rtol=1e-14)


def test_works_with_diffeqsolve():
    def solve(solver):
        return diffrax.diffeqsolve(
            TERM, solver, 0.0, 20.0, 0.1, START, args=0.1,
            stepsize_controller=diffrax.PIDController(rtol=1e-8, atol=1e-8),
        ).ys["x"][-1]  # fmt: skip

    mine = float(jax.jit(lambda: solve(vi.Unrolled(diffrax.Dopri8())))())
    assert mine == pytest.approx(float(solve(diffrax.Dopri8())), abs=1e-10)


@pytest.mark.slow
def test_implicit_step_equals_that_of_diffrax():
    kind, args = diffrax.Kvaerno5, 0.1
    solver = kind(root_finder=optx.Newton(rtol=1e-13, atol=1e-13))
    times = jnp.asarray(0.2), jnp.asarray(0.5)
    hidden = solver.init(TERM, *times, START, args)
    original = solver.step(TERM, *times, START, args, hidden, jnp.asarray(True))
    mine = vi.Unrolled(kind(), tolerance=1e-14).step(TERM, 0.2, 0.5, START, args, None, True)
    for name in START:
        np.testing.assert_allclose(mine[0][name], original[0][name], rtol=1e-12)
        np.testing.assert_allclose(mine[1][name], abs(original[1][name]), atol=1e-12)


@pytest.mark.parametrize("method", [vi.Adaptive, vi.FixedStep])
@pytest.mark.parametrize("solver", [diffrax.SemiImplicitEuler(), "Tsit5"])
def test_other_solvers_raise(method, solver):
    with pytest.raises(TypeError, match=r"`solver` must be an explicit or diagonally implicit"):
        method(solver)
    with pytest.raises(TypeError, match=r"`FixedStep` must be an explicit.*Use `Adaptive`"):
        vi.FixedStep(diffrax.Kvaerno5())
