"""A diffrax Runge–Kutta solver with its stages written out."""

from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree

from ._implicit import implicit_stages, weighted


class Unrolled(diffrax.AbstractSolver):
    """Any explicit or diagonally implicit diffrax Runge–Kutta solver, its stages written out.

    diffrax keeps the stages in a buffer filled by an inner loop, which XLA cannot fuse. This solver
    has the same tableau, error estimate and interpolant, and can be used anywhere a diffrax solver
    can. The stages of an implicit one are solved by Newton's method with one matrix for all of a
    step; its own `root_finder` is not used.

    **Arguments:** `solver`, a Runge–Kutta solver such as `diffrax.Tsit5()` or `diffrax.Kvaerno5()`;
    `tolerance`, to which stages are solved, relative to 1 + |y| (by default
    1e-12).

    **Raises:** `TypeError` if `solver` is not one.
    """

    solver: Any  # not yet known to be a solver when it is checked below
    tolerance: Any = eqx.field(kw_only=True, default=None)
    term_structure: ClassVar[Any] = diffrax.AbstractTerm

    def __check_init__(self):
        if not isinstance(self.solver, diffrax.AbstractERK | diffrax.AbstractESDIRK):
            raise TypeError(
                "Argument `solver` must be an explicit or diagonally implicit diffrax Runge–Kutta "
                f"solver, but got {self.solver!r}."
            )

    @property
    def implicit(self) -> bool:
        """Whether its stages are equations to be solved."""
        return isinstance(self.solver, diffrax.AbstractESDIRK)

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
        """One step over [t0, t1]."""
        y1, error, slopes, _ = self.step_with_stages(terms, t0, t1, y0, args)
        control = terms.contr(t0, t1)
        stages = [terms.prod(slope, control) for slope in slopes]
        k = jtu.tree_map(lambda *leaves: jnp.stack(leaves), *stages)
        return y1, error, {"y0": y0, "y1": y1, "k": k}, None, diffrax.RESULTS.successful

    def step_with_stages(self, terms, t0, t1, y0, args):
        """Return the end of a step over [t0, t1], its error, the slope of each stage, and share
        of the step, t, y and weight in the error of each."""
        tableau = _tableau(self.solver)
        control = terms.contr(t0, t1)
        if self.implicit:
            return self._implicit(terms, t0, t1, y0, args, control)
        # The length comes last: once for each sum of slopes, where it is part of the addition.
        slopes, y1 = [terms.vf(t0, y0, args)], None
        places = [(0.0, t0, y0)]

        def reached(weights):
            return jtu.tree_map(jnp.add, y0, terms.prod(weighted(weights, slopes), control))

        for a, c in zip(tableau.a_lower, tableau.c, strict=True):
            y1 = reached(a)
            t = t1 if c == 1 else t0 + float(c) * (t1 - t0)
            places.append((float(c), t, y1))
            slopes.append(terms.vf(t, y1, args))
        if not tableau.ssal or y1 is None:
            y1 = reached(tableau.b_sol)
        error = terms.prod(weighted(tableau.b_error, slopes), control)
        return y1, error, slopes, _with_weights(tableau, places)

    def error(self, slopes: list[Any], control: Any) -> Any:
        """The error of a step from the slopes of its stages and its length."""
        change = weighted(_tableau(self.solver).b_error, slopes)
        return jtu.tree_map(lambda x: control * x, change)

    def _implicit(self, terms, t0, t1, y0, args, control):
        """The step of an implicit solver; its error is infinite where a stage was not solved.

        **Arguments:** as `step`; `control`, the length of the step.
        """
        tableau = _tableau(self.solver)
        flat, unravel = ravel_pytree(y0)
        tolerance = 1e-12 if self.tolerance is None else self.tolerance

        def field(t, y):
            return ravel_pytree(terms.vf(t, unravel(y), args))[0]

        slopes, left = implicit_stages(tableau, field, t0, control, flat, tolerance)
        stages = [unravel(control * k) for k in slopes]
        error = jtu.tree_map(lambda e: jnp.abs(e) + left, weighted(tableau.b_error, stages))
        y1 = weighted(tableau.b_sol, stages, y0)
        assert tableau.a_diagonal is not None
        diagonal, places = tableau.a_diagonal[-1], [(0.0, t0, y0)]
        for n, (a, c) in enumerate(zip(tableau.a_lower, tableau.c, strict=True), start=2):
            there = weighted(np.append(a, diagonal), stages[:n], y0)
            places.append((float(c), t0 + float(c) * (t1 - t0), there))
        return y1, error, [unravel(k) for k in slopes], _with_weights(tableau, places)


def _with_weights(tableau: diffrax.ButcherTableau, places: list[tuple]) -> list[tuple]:
    """The stages with their weights in the error."""
    return [(*x, float(b)) for x, b in zip(places, tableau.b_error, strict=True)]


def _tableau(solver: Any) -> diffrax.ButcherTableau:
    tableau = solver.tableau
    if not isinstance(tableau, diffrax.ButcherTableau):
        raise TypeError(f"Argument `solver` must have one Butcher tableau, but got {solver!r}.")
    return tableau
