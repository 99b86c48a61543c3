"""The paper's equations as they are printed, to measure their errors."""

from math import pi
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from vi_jax.flow import Adaptive, simulate
from vi_jax.machine import AbstractMachine, RigidStop, State


class CoastingMachine(AbstractMachine):
    """The machine without motor, damping and loss at the stop (T0 = 0, c = 0, k = 1), in time τ.

    Its drive equation is Eq. 1 for u = cos φ with two switches, so that the correct form and the
    printed forms share one compiled program.
    """

    contacts: tuple[RigidStop, ...]  # pyright: ignore
    coupling: Float[Array, "..."]
    """Coefficient of the spring's reaction in the drive equation (dimensionless)."""
    slider_inertia: Float[Array, "..."]
    """μ, the inertia of the slider over that of the shaft (dimensionless)."""
    printed_inertia: Float[Array, "..."]
    """Coefficient of φ'² u''(φ) in place of μ u'(φ) u''(φ); 0 for the correct equation."""

    @property
    def cycle(self) -> float:
        """The body's natural period, 2π in time τ."""
        return 2 * pi

    def field(self, s: Float[Array, ""], state: State) -> dict[str, Any]:
        """Return d(state)/dτ of the state (Y, V, W, φ)."""
        sine, cosine = jnp.sin(state.phase), jnp.cos(state.phase)
        right = self.slider_inertia * sine * cosine
        factor = jnp.where(self.printed_inertia > 0, -self.printed_inertia * cosine, right)
        torque = -self.coupling * sine * (state.Y - cosine) - factor * state.W**2
        inertia = 1 + self.slider_inertia * sine**2
        return {"Y": state.V, "V": cosine - state.Y, "W": torque / inertia, "phase": state.W}


def energy(state: Any, *, coupling: float, slider_inertia: float) -> np.ndarray:
    """Return E = ½V² + ½(Y - U)² + ½(1 + μU_φ²)W²/ε, in units of k0 a², at each state."""
    Y, V, W, phase = (np.asarray(x) for x in (state.Y, state.V, state.W, state.phase))
    shaft = (1 + slider_inertia * np.sin(phase) ** 2) * W**2 / coupling
    return 0.5 * (V**2 + (Y - np.cos(phase)) ** 2 + shaft)


def energy_drift(
    *, coupling: float, slider_inertia: float, printed_coupling: float | None = None,
    printed_inertia: float = 0.0,
) -> float:  # fmt: skip
    """Return the greatest |E/E(0) - 1| of a coasting run over 20 natural periods (k = 1, d = 2).
    ε and μ define the energy; the drive equation is integrated with the printed coefficients."""
    coefficient = coupling if printed_coupling is None else printed_coupling
    machine = CoastingMachine(
        contacts=(RigidStop(2.0, 1.0),),
        coupling=jnp.asarray(coefficient, float),
        slider_inertia=jnp.asarray(slider_inertia, float),
        printed_inertia=jnp.asarray(printed_inertia, float),
    )
    start = State(Y=0.0, V=0.0, W=0.9, phase=0.0)
    run = simulate(
        machine, start, 20, method=Adaptive(rtol=1e-12), samples=16, throw=True,
        record="sections",
    )  # fmt: skip
    assert run.samples is not None
    E = energy(run.samples.state, coupling=coupling, slider_inertia=slider_inertia)
    return float(np.abs(E / E[0] - 1).max())


def eq21_misses(zeta: float, k: float, d: float, n: int, *, printed: bool) -> dict[str, float]:
    """Return the residuals of Eq. 14 with Eq. 20 and 21, as `printed` or with its factor ζ, in the
    boundary conditions (16), in units of a, and (17) and (18), in units of a per radian; with v0
    (dY/dφ before the impact) and φ0 (rad). ζ is not 1, the period is 2πn."""
    A = 1 / (1 - zeta**2)
    half = np.pi * n / zeta
    slope = (1.0 if printed else zeta) * (1 + k) / (2 * A) / np.tan(half)
    # sin² + cos² = 1 determines v0; the faster of the two impacts is taken.
    quadratic = [((1 - k) / (2 * A)) ** 2 + slope**2, 2 * d / A * slope, (d / A) ** 2 - 1]
    v0 = float(np.max(np.roots(quadratic).real))
    phase = float(np.arctan2(-(1 - k) / (2 * A) * v0, d / A + slope * v0))
    scale = (d - A * np.cos(phase)) / np.cos(half)
    middle = (np.pi * n + phase) / zeta
    C1, C2 = scale * np.cos(middle), scale * np.sin(middle)

    def motion(at):
        c, s = np.cos(at / zeta), np.sin(at / zeta)
        return C1 * c + C2 * s + A * np.cos(at), (C2 * c - C1 * s) / zeta - A * np.sin(at)

    (y0, w0), (y1, w1) = motion(phase), motion(phase + 2 * np.pi * n)
    return {
        "v0": v0,
        "phase": phase,
        "miss_16": float(max(abs(y0 - d), abs(y1 - d))),
        "miss_17_before": float(abs(w1 - v0)),
        "miss_17_after": float(abs(w0 + k * v0)),
        "miss_18": float(abs(w0 + k * w1)),
    }
