"""`spectrum`: the power spectrum of what a run recorded."""

import numpy as np

from .._checks import count, instance_of
from .._types import xr
from ..flow import Run
from ..machine import components


def spectrum(run: Run, of: str, *, segment: int | None = None) -> "xr.Dataset":
    """Compute the power spectral density of a state component or a quantity of the machine.

    The samples of each lane are cut into segments one after the other, and the spectra of all
    segments are averaged (Welch 1967, with Hann's window and without overlap, so that the scatter
    between them gives the error). The density is one-sided: its integral over the frequency is the
    variance. Frequencies are in cycles of a sine per unit of time; ω is 2π times them. Host-side:
    not to be traced.

    **Arguments:**

    - `run`: from `simulate` with `samples`, or a batch of them under `vmap`.
    - `of`: a state component (`"V"`) or one of the machine's quantities.
    - `segment`: samples in a segment; by default an eighth of the run. Lines closer together than
      some four divisions of its length are not told apart.

    **Returns:** an `xarray.Dataset` over `frequency`: `density`, `error` (its standard error; NaN
    of a single segment), and the number of `segments` among its attributes. Lanes that failed are
    left out.

    **Raises:** `ValueError` or `TypeError` for a run without samples, or with samples that are not
    evenly spaced in time, and for names that it does not have.
    """
    from scipy.signal import periodogram

    instance_of("run", run, Run, "a `Run`")
    if run.samples is None:
        raise ValueError("Argument `run` must have samples: give `simulate` a number of `samples`.")
    lead = run.steps.ndim
    rows = {**components(run.samples.state, lead + 1), **run.samples.quantities}
    if of not in rows:
        raise ValueError(f"Argument `of` must be one of {', '.join(rows)}, but got {of!r}.")
    good = np.asarray(run.successful).ravel()
    x = np.asarray(rows[of], float)[..., 1:]
    x = x.reshape(-1, x.shape[-1])[good]
    time = np.asarray(run.samples.time, float)
    time = time.reshape(-1, time.shape[-1])[good]
    if not len(x):
        raise ValueError("Argument `run` must have lanes that were simulated to their end.")
    steps = np.diff(time, axis=1)
    if np.ptp(steps) > 1e-6 * np.mean(steps):
        raise ValueError(
            "Argument `run` must have samples evenly spaced in time, but those of a machine whose "
            "drive does not turn evenly are not."
        )
    size = max(2, x.shape[1] // 8) if segment is None else segment
    size = count("segment", size, least=2, most=x.shape[1])
    parts = x[:, x.shape[1] % size :].reshape(-1, size)
    frequency, found = periodogram(
        parts, fs=1.0 / float(np.mean(steps)), window="hann", detrend="constant"
    )
    error = np.full(frequency.size, np.nan)
    if len(parts) > 1:
        error = found.std(axis=0, ddof=1) / len(parts) ** 0.5
    return xr.Dataset(
        {"density": ("frequency", found.mean(axis=0)), "error": ("frequency", error)},
        {"frequency": frequency},
        {"segments": len(parts), "of": of},
    )
