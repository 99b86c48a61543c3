"""`sweep`: a parameter changed little by little, the motion carried from value to value."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from .._checks import concrete, count, fits_records, instance_of, number, require
from .._programs import compiled
from ..flow import RESULTS, simulate
from ..flow.arguments import check_start
from ..flow.methods import MethodLike, chosen
from ..orbit.results import impacts_in_words
from ..scene import LABELS, AbstractScene
from ..scene.numbers import check_again, check_leaf, with_leaf
from .regime import REGIMES, impacts_of, least_period

# A jump is so many times the change at the values beside it, and this part of 1 + |number|.
_JUMP, _NOTED = 3.0, 0.01


class Sweep(eqx.Module):
    """What a sweep settled on at each value, in their order. Under `vmap` batch axes come first."""

    parameter: str = eqx.field(static=True)
    """Name of the number that was changed."""
    values: Float[Array, "..."]
    """Its values."""
    y_min: Float[Array, "..."]
    """Smallest Y over the cycles observed (unit: a)."""
    y_max: Float[Array, "..."]
    """Largest Y over the cycles observed (unit: a)."""
    period: Int[Array, "..."]
    """Period in drive cycles, or `REGIMES.unsettled` if none was found, or `REGIMES.failed`."""
    impacts: Float[Array, "..."]
    """Impacts in a period; in a cycle, on average, where there is no period."""
    frequency_ratio: Float[Array, "..."] | None
    """ζ: mean crank speed (unit: ω); `None` for scenes that are not driven."""
    impact_speed: Float[Array, "..."]
    """Greatest V⁻ over the cycles observed (unit: a ω)."""
    sections: Any
    """Section states of the cycles observed; leaves (values, cycles)."""
    result: RESULTS
    """Whether each value was simulated to its end."""
    labels: tuple[str, str] = eqx.field(static=True, default=LABELS)
    """What pictures write beside position and velocity, in the scene's words."""
    periods: tuple[str, ...] = eqx.field(static=True, default=())
    """Names of the periods of 1, 2, ... cycles, in the scene's words."""

    @property
    def successful(self) -> Bool[Array, "..."]:
        """Whether each value was simulated to its end."""
        return self.result == RESULTS.successful

    def __str__(self) -> str:
        if isinstance(self.values, Tracer) or self.values.ndim != 1:
            return repr(self)
        values, lines = np.asarray(self.values), []
        kinds, jumps = self._kinds(), self._jumps()
        for i, value in enumerate(values):
            same = bool(i) and kinds[i] == kinds[i - 1]
            if same and not jumps[i]:
                continue
            line = f"  {'still ' if same else ''}{kinds[i]} from {value:.6g}"
            if jumps[i]:
                line += f", jump since {values[i - 1]:.6g}: {', '.join(jumps[i])}"
            lines.append(line)
        if len(lines) > 12:
            lines = [*lines[:12], f"  {len(lines) - 12} further changes"]
        return "\n".join([f"Sweep of {self.parameter}, {values.size} values:", *lines])

    def _kinds(self) -> list[str]:
        """The motion at each value in words: its period and its impacts."""
        names: dict[int, str] = {
            REGIMES.unsettled: "no period",
            REGIMES.failed: REGIMES.failed.meaning,
        }
        periods = dict(enumerate(self.periods, 1))
        return [
            names.get(int(p))
            or f"{periods.get(int(p), f'{2 * int(p)}π')} with {impacts_in_words(round(float(n)))}"
            for p, n in zip(np.asarray(self.period), np.asarray(self.impacts), strict=True)
        ]

    def _jumps(self) -> list[list[str]]:
        """What changes at each value by far more than at the values beside it.

        Not looked for within motions without a period, whose extremes differ by chance.
        """
        numbers = {"min Y": self.y_min, "max Y": self.y_max, "ζ": self.frequency_ratio}
        period = np.asarray(self.period)
        found: list[list[str]] = [[] for _ in period]
        for name, x in numbers.items():
            if x is None:
                continue
            x = np.asarray(x)
            steps = np.abs(np.diff(x))
            beside = np.nan_to_num(np.concatenate([[0.0], steps, [0.0]]))
            usual = np.maximum(beside[:-2], beside[2:])
            scale = 1 + np.maximum(np.abs(x[1:]), np.abs(x[:-1]))
            far = (steps > _JUMP * usual) & (steps > _NOTED * scale)
            far &= (period[1:] > 0) | (period[:-1] > 0)
            for i in np.flatnonzero(far) + 1:
                found[i].append(f"{name} {x[i - 1]:.6g} → {x[i]:.6g}")
        return found


def sweep(
    scene: AbstractScene,
    parameter: str,
    values: Any,
    *,
    start: Any = None,
    settle: int = 200,
    cycles: int = 32,
    method: MethodLike = None,
    clock: str | None = None,
    tolerance: float = 1e-6,
    max_steps: int | None = None,
) -> Sweep:
    """Quasi-static sweep: run-up with rising values, close-down with falling ones.

    At each value the motion goes on from where it was at the one before (what the paper calls the
    continuation method), so that it keeps to its branch until that ends: up and down show
    hysteresis. Clean under `jit` and `vmap` (over other parameters, starts, or values).

    **Arguments:**

    - `scene`, `parameter`: the scene and the name of the number that is changed, such as
      `"drive.frequency_ratio"`.
    - `values`: its values in the order of the sweep.
    - `start`: state at the first value; by default at rest (a motor at its no-load speed).
    - `settle`, `cycles`: drive cycles at each value before observing, and observed; static.
    - `method`, `clock`: as for `simulate`; by default the `"standard"` preset.
    - `tolerance`: how closely sections must repeat for a period.
    - `max_steps`: steps at each value beyond which it counts as failed.

    **Returns:** a `Sweep`. A value that fails is NaN, and the next goes on from the one before it.

    **Raises:** `ValueError` or `TypeError` for an unknown name or values that are no numbers.
    """
    instance_of("scene", scene, AbstractScene, "a `Scene` or an `AbstractScene`")
    check_leaf(scene, parameter)
    settle, cycles = count("settle", settle), count("cycles", cycles, least=2)
    values = number("values", values).astype(jnp.result_type(float))
    numbers = concrete(values)
    if max_steps is not None:
        max_steps = count("max_steps", max_steps, least=1)
    fits_records("cycles", values.size * cycles, 4)
    require("tolerance", tolerance, low=0.0, open_low=True)
    if values.ndim != 1 or not values.size or not _finite(numbers):
        infinite = values.ndim == 1 and values.size
        raise ValueError(
            "Argument `values` must be finite numbers in one row, but has shape "
            f"{values.shape}{' and numbers that are not finite' if infinite else ''}."
        )
    rests = True
    if numbers is not None:
        ends = [with_leaf(scene, parameter, value) for value in {numbers.min(), numbers.max()}]
        for end in ends:
            check_again(end)
        rests = any(end.may_rest() for end in ends)
    if start is None:
        start = with_leaf(scene, parameter, values[0]).start()
    method = chosen(scene, method)
    if clock is not None:
        scene = scene.in_clock(clock)
    start = scene.adopt(start)
    start = jtu.tree_map(lambda x: jnp.asarray(x, values.dtype), start)
    if numbers is not None:
        check_start(with_leaf(scene, parameter, numbers[0]), start)
    return _sweep(
        scene, parameter, values, start, settle, cycles, method, rests, tolerance, max_steps
    )


def _finite(numbers: np.ndarray | None) -> bool:
    return numbers is None or bool(np.isfinite(numbers).all())


def taken_along(scene: AbstractScene, state: Any) -> Any:
    """The state, the body taken along by a stop that has come nearer."""
    for stop in scene.stops:
        body = scene.coordinates[stop.coordinate]
        Y = body.position(state)
        beyond = stop.beyond(Y) > 0
        moved = body.placed(state, stop.place, jnp.zeros_like(Y))
        state = jtu.tree_map(lambda a, b, c=beyond: jnp.where(c, a, b), moved, state)
    return state


@compiled
def _sweep(
    scene, parameter, values, start, settle, cycles, method, rests, tolerance, max_steps
) -> Sweep:
    def one(state, value):
        here = with_leaf(scene, parameter, value)
        state = taken_along(here, state)
        run = simulate(
            here, state, cycles, settle=settle, method=method, rests=rests, max_steps=max_steps
        )
        sections = jtu.tree_map(lambda x: x[1:], run.sections)
        state = jtu.tree_map(lambda a, b: jnp.where(run.successful, a, b), run.last, state)
        assert run.y_min is not None and run.y_max is not None
        assert run.impact_speed is not None and run.duration is not None
        period = least_period(sections, longest=cycles // 2, tolerance=tolerance)
        impacts = impacts_of(run.impacts.astype(value.dtype), period)
        return state, Sweep(
            parameter=parameter,
            values=value,
            y_min=jnp.min(run.y_min),
            y_max=jnp.max(run.y_max),
            period=jnp.where(run.successful, period, REGIMES.failed),
            impacts=jnp.where(run.successful, impacts, jnp.nan),
            frequency_ratio=here.frequency_ratio(jnp.mean(run.duration)),
            impact_speed=jnp.max(run.impact_speed),
            sections=sections,
            result=run.result,
            labels=scene.labels,
            periods=tuple(scene.period_of(n) for n in range(1, cycles // 2 + 1)),
        )

    return jax.lax.scan(one, start, values)[1]
