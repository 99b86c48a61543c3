"""Solvers as diffrax's classes. diffrax takes long to load, so this module is loaded when used."""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import jax.numpy as jnp
import jax.tree_util as jtu

from . import verner
from .runge_kutta import UnrolledStages


class Verner9(verner.Verner9, diffrax.AbstractERK):
    """Verner's method of order 9 with an error estimate of order 8, in 15 stages and one for the
    estimate; for `FixedStep`, `Adaptive`, or diffrax itself.

    8 steps a cycle are as accurate as 12 of `diffrax.Dopri8` for the paper's motor (error 4e-10),
    and 20 as 36 (7e-14). Steps end on samples here; diffrax's own interpolation is cubic.
    """

    tableau: ClassVar[Any] = diffrax.ButcherTableau(
        *(getattr(verner.Verner9.tableau, name) for name in ("c", "b_sol", "b_error", "a_lower"))
    )
    interpolation_cls: ClassVar[Callable] = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k


class Unrolled(UnrolledStages, diffrax.AbstractSolver):
    """Any explicit or diagonally implicit diffrax Runge–Kutta solver, with its stages unrolled.

    diffrax keeps the stages in a buffer filled by an inner loop, which XLA cannot fuse. This solver
    has the same tableau, error estimate and interpolant, and can replace a diffrax solver anywhere.
    The stages of an implicit solver are solved by Newton's method with one matrix for all stages of
    a step; its own `root_finder` is not used.

    **Arguments:** `solver`, a Runge–Kutta solver such as `diffrax.Tsit5()` or `diffrax.Kvaerno5()`;
    `tolerance` of the stages, relative to `sizes` + |y| (default 1e-12); `sizes`, a number for each
    array of y (default 1).

    **Raises:** `TypeError` if `solver` is not one.
    """

    term_structure: ClassVar[Any] = diffrax.AbstractTerm

    @property
    def interpolation_cls(self):  # pyright: ignore
        return self.solver.interpolation_cls

    def init(self, terms, t0, t1, y0, args):
        """Return `None`: the first stage is evaluated anew in each step."""
        return None

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y1, error, slopes, _ = self.step_with_stages(terms, t0, t1, y0, args)
        control = terms.contr(t0, t1)
        stages = [terms.prod(slope, control) for slope in slopes]
        k = jtu.tree_map(lambda *leaves: jnp.stack(leaves), *stages)
        return y1, error, {"y0": y0, "y1": y1, "k": k}, None, diffrax.RESULTS.successful
