"""`escape_rate`: the rate at which lanes escape, from those that do and those that do not."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from .._checks import given_number, require, tuple_of_names
from .._types import xr


def escape_rate(
    data: "xr.Dataset",
    over: str | Iterable[str] | None = None,
    *,
    after: Any = 0.0,
    confidence: Any = 0.95,
) -> "xr.Dataset":
    """Estimate the rate at which lanes escape, per cycle, with its confidence interval.

    Lanes that do not escape count with the time for which they were watched: the rate is the
    number of escapes over the time of all lanes until then (maximum likelihood for escapes at a
    constant rate), and its interval that of a Poisson number (Garwood 1936), from below to 0 where
    none escapes. An escape that is seen at instants only, `step` apart, happened between two of
    them, which is allowed for. Host-side: not to be traced.

    **Arguments:**

    - `data`: what `scan` found with the measure `Escape`.
    - `over`: the dimensions whose lanes are taken together; by default all of them.
    - `after`: cycles that are left out, with the lanes that escape in them: escapes come at a
      constant rate only once the start is forgotten. Compare two of them.
    - `confidence` of the interval.

    **Returns:** an `xarray.Dataset` over the other dimensions: `rate`, `rate_low` and `rate_high`
    (1/cycle), `escapes`, `censored` (lanes that did not escape) and `cycles` (time of all lanes).

    **Raises:** `ValueError` or `TypeError` for data without escapes or dimensions they do not have.
    """
    from scipy.stats import chi2

    after = given_number("after", after, low=0.0)
    require("confidence", confidence, low=0.0, high=1.0, open_low=True, open_high=True)
    if not {"escape_cycle", "escaped"} <= set(getattr(data, "data_vars", ())):
        raise ValueError(
            "Argument `data` must be what `scan` found with the measure `Escape`, but has no "
            "`escape_cycle` and `escaped`."
        )
    time = data["escape_cycle"]
    dims = [str(name) for name in time.dims]
    names = tuple_of_names("over", dims if over is None else over)
    for name in names:
        if name not in dims:
            raise ValueError(
                f"Argument `over` must name dimensions of the lanes, {', '.join(dims)}, "
                f"but got {name!r}."
            )
    step = float(time.attrs.get("step", 1.0))
    watched = time > after  # not so for lanes that failed, which are NaN
    escaped = watched & (data["escaped"] == 1)
    escapes = escaped.sum(names)
    looks = ((time - after) / step).where(watched, 0.0).sum(names)
    tail = 0.5 * (1.0 - confidence)

    def rate(number: Any) -> Any:
        """Of so many escapes: at each look a part of the lanes that are left."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return -np.log1p(-np.minimum(number / looks, 1.0)) / step

    low = xr.apply_ufunc(lambda n: np.where(n > 0, 0.5 * chi2.ppf(tail, 2 * n), 0.0), escapes)
    high = xr.apply_ufunc(lambda n: 0.5 * chi2.ppf(1 - tail, 2 * n + 2), escapes)
    found = xr.Dataset(
        {
            "rate": rate(escapes),
            "rate_low": rate(low),
            "rate_high": rate(high),
            "escapes": escapes,
            "censored": (watched & ~escaped).sum(names),
            "cycles": looks * step,
        }
    )
    for name in ("rate", "rate_low", "rate_high"):
        found[name].attrs["units"] = "1/cycle"
    found["cycles"].attrs["units"] = "cycle"
    found.attrs["confidence"] = float(confidence)
    return found
