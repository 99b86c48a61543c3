"""Pictures of quasi-periodic motions: the curve on the section, and families of tori."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from .._checks import instance_of, one_of
from ..flow import Run
from ..machine import components, in_brackets, unit_of, units_of, without_modes
from ..orbit import KINDS, Torus, TorusBranch
from .colors import BLUE, ORANGE, draw_mark, once, thick
from .motion import new_axes
from .orbit import axis_name

# Points of a drawn curve.
_POINTS = 1024

_QUANTITIES = ("rotation", "exponents", "clearance", "slowest_impact")


def plot_torus(
    found: Torus | TorusBranch,
    *,
    ax: Axes | None = None,
    x: str | None = None,
    y: str | None = None,
    run: Run | None = None,
    **style: Any,
) -> Axes:
    """Draw a torus as its curve on the section, or a quantity along a family of tori.

    **Arguments:**

    - `found`: a `Torus`, or a `TorusBranch`, whose windows of locking are shaded and whose ends at
      a grazing or a Neimark–Sacker point are marked.
    - `ax`: by default a new figure.
    - `x`, `y`: for a torus two components of the state, by default the first two; for a family `y`
      is `"rotation"` (the default), `"exponents"`, `"clearance"` or `"slowest_impact"`.
    - `run`: a simulated motion, with sections drawn as dots for comparison with a torus.
    - options of `Axes.plot`.
    """
    ax = new_axes(ax)
    if isinstance(found, TorusBranch):
        return _draw_family(found, ax, "rotation" if y is None else y, style)
    instance_of("found", found, Torus, "a `Torus` or a `TorusBranch`")
    curve = components(found.at(np.linspace(0, 1, _POINTS)), 1)
    names = tuple(curve)
    x, y = one_of("x", x or names[0], names), one_of("y", y or names[1], names)
    if run is not None:
        dots = components(without_modes(run.sections), 1)
        ax.plot(dots[x], dots[y], ".", ms=2, color="0.3", label=once(ax, "sections of a run"))
    look = {"color": BLUE, "lw": thick(1.6), "label": once(ax, "torus"), **style}
    ax.plot(curve[x], curve[y], **look)
    units = units_of(found.machine)
    ax.set_xlabel(in_brackets(f"{x} on the section", unit_of(units, x)))
    ax.set_ylabel(in_brackets(f"{y} on the section", unit_of(units, y)))
    return ax


def _draw_family(family: TorusBranch, ax: Axes, name: str, style: dict[str, Any]) -> Axes:
    one_of("y", name, _QUANTITIES)
    if name in ("rotation", "exponents"):
        values = getattr(family, name)
    else:
        values = np.array([getattr(torus, name) for torus in family.tori])
    ax.plot(family.parameter, values, **{"color": BLUE, "lw": thick(1.6), **style})
    for window in family.windows:
        if np.isfinite(window.low):
            word = once(ax, "window of locking")
            ax.axvspan(window.low, window.high, color=ORANGE, lw=thick(1.0), label=word)
    for end, i in zip(family.ends, (0, -1), strict=True):
        if end in KINDS:
            for value in np.atleast_1d(values[i]):
                draw_mark(ax, end, family.parameter[i], value)
    ax.set_xlabel(axis_name(family.name, units_of(family.tori[0].machine)))
    words = {"rotation": "rotation number ρ", "exponents": "exponents (1/cycle)"}
    ax.set_ylabel(words.get(name, name.replace("_", " ")))
    if ax.get_legend_handles_labels()[0]:
        ax.legend(fontsize="small", frameon=False)
    return ax
