"""A diffrax Runge–Kutta solver with its stages written out."""

from typing import Any, ClassVar

import diffrax
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np


class Unrolled(diffrax.AbstractSolver):
    """Any explicit diffrax Runge–Kutta solver, unrolled so that its stages fuse.

    diffrax keeps the stages in a buffer filled by an inner loop, which XLA cannot fuse. This solver
    has the same tableau, error estimate and interpolant, evaluates them over the leaves of the
    state, and can be used anywhere a diffrax solver can.

    **Arguments:** `solver`, an explicit Runge–Kutta solver such as `diffrax.Tsit5()`.

    **Raises:** `TypeError` if `solver` is not one.
    """

    solver: Any  # not yet known to be a solver when it is checked below
    term_structure: ClassVar[Any] = diffrax.AbstractTerm

    def __check_init__(self):
        if not isinstance(self.solver, diffrax.AbstractERK):
            raise TypeError(
                "Argument `solver` must be an explicit diffrax Runge–Kutta solver, but got "
                f"{self.solver!r}."
            )

    @property
    def interpolation_cls(self):  # pyright: ignore
        """The interpolant of the wrapped solver."""
        return self.solver.interpolation_cls

    def order(self, terms):
        """Order of the wrapped solver."""
        return self.solver.order(terms)

    def init(self, terms, t0, t1, y0, args):
        """No hidden state: the first stage is evaluated anew in each step."""
        return None

    def func(self, terms, t0, y0, args):
        """The vector field at a point."""
        return terms.vf(t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """One step over [t0, t1], with the arguments and results of `diffrax`'s `step`."""
        tableau = _tableau(self.solver)
        control = terms.contr(t0, t1)
        stages = [terms.vf_prod(t0, y0, args, control)]
        y1 = None
        for a, c in zip(tableau.a_lower, tableau.c, strict=True):
            y = _combine(y0, a, stages)
            t = t1 if c == 1 else t0 + float(c) * (t1 - t0)
            stages.append(terms.vf_prod(t, y, args, control))
            y1 = y
        if not tableau.ssal or y1 is None:
            y1 = _combine(y0, tableau.b_sol, stages)
        error = _combine(None, tableau.b_error, stages)
        k = jtu.tree_map(lambda *leaves: jnp.stack(leaves), *stages)
        return y1, error, {"y0": y0, "y1": y1, "k": k}, None, diffrax.RESULTS.successful


def _tableau(solver: diffrax.AbstractERK) -> diffrax.ButcherTableau:
    tableau = solver.tableau
    if not isinstance(tableau, diffrax.ButcherTableau):
        raise TypeError(f"Argument `solver` must have one Butcher tableau, but got {solver!r}.")
    return tableau


def _combine(base: Any, weights: np.ndarray, stages: list) -> Any:
    """base + Σ weight·stage, leaf by leaf, without the zero weights."""
    used = [(float(w), stage) for w, stage in zip(weights, stages, strict=False) if w != 0]

    def leaf(*leaves: jax.Array) -> jax.Array:
        terms = [w * x for (w, _), x in zip(used, leaves, strict=True)]
        total = terms[0]
        for term in terms[1:]:
            total = total + term
        return total

    change = jtu.tree_map(leaf, *(stage for _, stage in used))
    return change if base is None else jtu.tree_map(jnp.add, base, change)
