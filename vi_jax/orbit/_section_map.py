"""A periodic motion that rests on a stop, as a fixed point of the section map.

From impact to impact such a motion has endlessly many equations, as the impacts before a rest are
endless. The section map has one for each number of the state: chatter is completed at once and rest
forgets how it began, so that the map is smooth, though of lower rank, as long as no rest and no
impact outside of a chatter is gained or lost.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array

from .._types import Scalar, State, Vector
from ..flow import MethodLike, Run, means, simulate
from ..machine import (
    AbstractMachine,
    bare,
    in_rows,
    is_autonomous,
    leaf,
    modes_of,
    raveled,
    with_modes,
)
from ._cycle_map import CycleMap
from ._fixed_step_method import fixed_step_method
from ._observed import Counted, Observed
from ._problem import sized
from ._shooting import Leg, Shooting
from ._turns import Nearest
from .floquet import multipliers_of
from .results import Orbit

# Impacts of a cycle that are listed, hops of a chatter included: a choice. Others are counted only.
_LISTED = 32


class SectionMap(Shooting):
    """The equations P(u; p) - u = 0 of a fixed point of the section map P, which the simulator
    carries through impacts, chatter, rest and release; the unknowns are (u, p).

    Of the fields of `Shooting`, `events` is empty and `steps` is not used.
    """

    @property
    def follows_events(self) -> bool:
        """Whether the events are given, and in that order; here the simulator finds them."""
        return False

    @property
    def autonomous(self) -> bool:
        """Whether the period is an unknown; here it follows from the state on the section."""
        return False

    def _map(self, machine: AbstractMachine, u: Vector) -> Vector:
        """The state a period after `u`."""
        carried = CycleMap(machine, self.method, self.cycles, True)
        return raveled(carried(self._begun(machine, u)))[0]

    def own_modes(self, leg: Leg) -> tuple[Array, ...]:
        """The machine's own modes on the section: all that `modes` has."""
        return self.modes_in(leg)

    def _begun(self, machine: AbstractMachine, u: Vector) -> State:
        """The state `u`, put on those stops that it is beyond: where the motion rests on its
        section a guess of the state there may be."""
        state = self.unravel(u)
        for stop in machine.stops:
            body = machine.coordinates[stop.coordinate]
            beyond = stop.beyond(body.position(state)) > 0
            there = body.placed(state, stop.place, body.velocity(state))
            state = jtu.tree_map(partial(jnp.where, beyond), there, state)
        return with_modes(state, self.own_modes(0))

    def flown(self, x: Vector, **options: Any) -> Run:
        """The motion of a period, simulated with these options."""
        machine = self.at(x)
        begin = self._begun(machine, x[: self.states])
        return simulate(machine, begin, self.cycles, method=self.method, **options)

    def lacks(self, x: Vector) -> Vector:
        """What the motion lacks to be periodic."""
        u = x[: self.states]
        return self._map(self.at(x), u) - u

    def observe(self, x: Vector) -> Observed:
        """Multipliers, extremes, impacts and rests of a solution `x`."""
        machine, u = self.at(x), x[: self.states]
        run = self.flown(x, impact_log=_LISTED, rests=True)
        log, duration = run.impact_log, run.duration
        assert log is not None and duration is not None and run.rests is not None
        assert run.y_min is not None and run.y_max is not None and run.clearance is not None
        monodromy = jax.jacfwd(lambda u: self._map(machine, u))(u)
        begins = jnp.cumsum(duration) - duration
        if not is_autonomous(machine, self.like):
            begins = jnp.asarray(machine.cycle, x.dtype) * jnp.arange(self.cycles)
        clock = (log.phase + begins[:, None]).ravel()
        listed = Counted(
            jnp.sum(run.impacts), jnp.sum(run.rests), clock, log.speed.ravel(), log.stop.ravel()
        )
        one, time = jnp.ones((), x.dtype), jnp.sum(duration)
        nearest = Nearest(jnp.min(run.clearance), jnp.nan * one, -one)
        integrals = {name: jnp.sum(a * duration) for name, a in run.averages.items()}
        return Observed(
            multipliers=multipliers_of(monodromy),
            monodromy=monodromy,
            approach=jnp.zeros((0,), x.dtype),
            y_min=jnp.min(run.y_min),
            y_max=jnp.max(run.y_max),
            nearest=nearest,
            order=one,
            apart=jnp.inf * one,
            duration=time,
            averages=means(integrals, time),
            largest=jnp.full((self.states,), jnp.nan, x.dtype),
            counted=listed,
        )

    def state_at(self, x: Vector, leg: Leg, s: Scalar) -> State:
        """The state on the section that is met at clock `s`, counted in whole cycles."""
        rows = in_rows(self.flown(x, record="sections", rests=True).sections)
        return self.unravel(rows[jnp.round(s / self.at(x).cycle).astype(int)])


def section_map_of(
    orbit: Orbit, parameter: str, method: MethodLike
) -> tuple[SectionMap, np.ndarray]:
    """The equations of a motion that rests, and the unknowns it gives."""
    machine = orbit.machine
    carried = fixed_step_method(method, orbit.method, machine)
    problem = SectionMap(
        machine, carried, bare(orbit.state), int(orbit.cycles), (),
        (tuple(float(mode) for mode in modes_of(orbit.state) or ()),), 1, (parameter,),
    )  # fmt: skip
    x = np.append(raveled(orbit.state)[0], float(leaf(machine, parameter)))
    return sized(problem, x), x
