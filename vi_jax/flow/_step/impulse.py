"""An impulse of white noise at an instant of a cycle, and how the motion goes on behind it."""

import jax.numpy as jnp
from jax.lax import stop_gradient

from ..._types import Flag
from ...machine import SoftStop, struck_modes
from .._lane import Lane, Plan, select
from ..integrals import TIME
from ..noise import kicked
from .happen import after_jump, let_go, unheld


def shaken(plan: Plan, lane: Lane, reached: Flag, completed: Flag) -> Lane:
    """The lane behind the impulse at the end of a piece of its cycle.

    **Arguments:** whether that end is `reached`; whether an interval is `completed` with it.
    """
    assert plan.noise is not None
    old, since = lane, None
    if lane.shaken is not None:
        time = lane.record.integrals[TIME]
        since, reading = time - lane.shaken, jnp.where(completed, 0.0, time)
        lane = lane._replace(shaken=jnp.where(reached, reading, lane.shaken))
    where = stop_gradient((plan.cycle_of(lane.done), lane.part))
    lane = lane._replace(state=kicked(plan.noise, reached, *where, old.state, since))
    if _may_change_modes(plan):
        # A body that was moved rests no longer, which friction on its stop has to know.
        contact = unheld(plan, lane, reached, old.state) or ()
        modes = struck_modes(plan.machine, lane.s, lane.state, lane.modes, contact=contact)
        lane = lane._replace(modes=select(reached, modes, old.modes))
    lane = after_jump(plan, lane, reached, old.state)
    freed = let_go(plan, lane, reached, reached, (old.state, old.modes))
    return freed._replace(record=lane.record)  # where nothing is logged of impulses


def _may_change_modes(plan: Plan) -> bool:
    """Whether a jump of velocities may put a switch into another mode: all but adhesive soft stops,
    which know a body's place alone."""
    return any(not (isinstance(x, SoftStop) and x.adhesive) for x in plan.machine.switches)
