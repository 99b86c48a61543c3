"""Flight in closed form: the ideally driven oscillator between impacts."""

from math import factorial

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import count
from ..scene import AbstractScene, CosineCrank, IdealDrive, OscillatorState, Scene
from ..scene.trig import horner, sincos
from .methods import AbstractMethod

Scalar = Float[Array, ""]

_COS = tuple((-1) ** n / factorial(2 * n) for n in range(10))
_SINC = tuple((-1) ** n / factorial(2 * n + 1) for n in range(10))
_EXP_SLOPE = tuple(1 / factorial(n + 1) for n in range(10))

# Below this distance from resonance |1 - ζ² + 2iξζ| the steady response, which grows like its
# inverse, would cancel against the free one; the response from rest is summed instead.
_NEAR = 1e-2


class ExactFlight(AbstractMethod):
    """The closed form of Y'' + 2ξY' + Y = cos φ between impacts; only impact times need a root.

    Holds for every ξ ≥ 0 (under-, critically and over-damped) and every ζ > 0, ζ = 1 with ξ = 0
    (the secular case) included. For ideal drives with a `CosineCrank`. The motion is followed in
    arcs of at most a fifth of the shorter period, each ended at the next turning point, so that
    an impact is missed only if it is shallower than rounding.

    **Arguments:** `steps_per_cycle`, arcs in a turn (default 5, the fewest). More of them change
    nothing but the rounding.

    **Raises:** `ValueError` for fewer than 5 arcs.
    """

    steps_per_cycle: int = eqx.field(static=True, default=5)  # pyright: ignore

    def __check_init__(self):
        count("steps_per_cycle", self.steps_per_cycle, least=5)

    def tighter(self):
        """Three more arcs: the difference is what rounding has grown to."""
        return ExactFlight(self.steps_per_cycle + 3)

    @property
    def uses_field(self) -> bool:
        """False: the flight is written out."""
        return False

    def check(self, scene):
        """Refuse scenes whose flight has no closed form."""
        if not isinstance(scene, Scene) or not isinstance(scene.drive, IdealDrive):
            drive = type(scene.drive if isinstance(scene, Scene) else scene).__name__
            raise ValueError(
                "Method `ExactFlight` needs a `Scene` with an `IdealDrive`, but got a "
                f"`{drive}`. Use `Adaptive` or `FixedStep`."
            )
        if not isinstance(scene.crank, CosineCrank):
            raise ValueError(
                "Method `ExactFlight` needs a `CosineCrank`, but the scene has a "
                f"`{type(scene.crank).__name__}`. Use `Adaptive` or `FixedStep`."
            )

    def step(self, scene, s0, s1, state, time):
        """The flight from `s0` to `s1`, exact to rounding."""
        assert isinstance(scene, Scene)
        zeta, xi, in_phase = _numbers(scene)
        tau = (s1 - s0) / zeta if in_phase else s1 - s0
        phase = scene.phase_at(s0 if in_phase else zeta * s0)
        Y, V = flight(zeta, xi, phase, state.Y, state.V, tau)
        return OscillatorState(Y, V), time, jnp.zeros_like(s0)


def _numbers(scene: AbstractScene) -> tuple[Scalar, Scalar, bool]:
    """ζ, ξ and whether the scene is in the phase clock."""
    assert isinstance(scene, Scene) and isinstance(scene.drive, IdealDrive)
    return scene.drive.frequency_ratio, scene.damping_ratio, scene.clock_name == "phase"


def flight(
    zeta: Scalar, xi: Scalar, phase: Scalar, Y: Scalar, V: Scalar, tau: Scalar
) -> tuple[Scalar, Scalar]:
    """Y and V after a time τ of free flight from (Y, V) at crank angle `phase`.

    Dimensionless scalars; |τ| up to a fifth of the shorter of the periods 2π and 2π/ζ, less
    under strong damping (|ξτ| ≤ 0.4π). Paper, Eq. 14, here with damping.
    """
    # C = cos(ω_d τ) and S = sin(ω_d τ)/ω_d are entire in ω_d² = 1 - ξ², whatever its sign.
    square = (1 - xi * xi) * tau * tau
    C, S = horner(_COS, square), tau * horner(_SINC, square)
    fade = jnp.exp(-xi * tau)

    sine0, cosine0 = sincos(phase)
    sine1, cosine1 = sincos(phase + zeta * tau)
    detune, drag = 1 - zeta * zeta, 2 * xi * zeta
    size = detune * detune + drag * drag
    near = size < _NEAR * _NEAR
    scale = 1 / jnp.where(near, 1.0, size)
    # Near resonance both are replaced by the response from rest.
    P = jnp.where(near, 0.0, detune * scale)
    Q = jnp.where(near, 0.0, drag * scale)
    y = Y - (P * cosine0 + Q * sine0)
    v = V - zeta * (Q * cosine0 - P * sine0)
    Y_rest, V_rest = _from_rest(
        jnp.where(near, zeta, 1.0), jnp.where(near, xi, 0.0),
        (cosine0, sine0), (cosine1, sine1), tau,
    )  # fmt: skip
    Y1 = fade * ((C + xi * S) * y + S * v) + P * cosine1 + Q * sine1
    V1 = fade * ((C - xi * S) * v - S * y) + zeta * (Q * cosine1 - P * sine1)
    return Y1 + jnp.where(near, Y_rest, 0.0), V1 + jnp.where(near, V_rest, 0.0)


def _times(a, b):
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def _minus(a, b):
    return a[0] - b[0], a[1] - b[1]


def _from_rest(zeta, xi, begin, end, tau):
    """Response from rest at phases whose (cos, sin) are `begin` and `end`, near resonance only.

    With p = -ξ + iω_d it is Re{[τ e^{pτ} E(w) e^{iφ0} - (e^{iφ1} - e^{p̄τ} e^{iφ0})/(iζ - p̄)]
    / (2iω_d)}, w = (iζ - p)τ, where E(w) = (e^w - 1)/w stays smooth through resonance. Complex
    numbers are pairs, because pairs of floats fuse.
    """
    omega = (1 - xi * xi) ** 0.5
    fade = jnp.exp(-xi * tau)
    sine, cosine = sincos(omega * tau)
    decay = (fade * cosine, fade * sine)
    w = (xi * tau, (zeta - omega) * tau)
    series = (jnp.full_like(tau, _EXP_SLOPE[-1]), jnp.zeros_like(tau))
    for coefficient in _EXP_SLOPE[-2::-1]:
        re, im = _times(series, w)
        series = (re + coefficient, im)
    resonant = _times(_times(decay, series), (tau * begin[0], tau * begin[1]))
    other = (xi, zeta + omega)
    scale = 1 / (other[0] ** 2 + other[1] ** 2)
    inverse = (other[0] * scale, -other[1] * scale)
    turned = _times((decay[0], -decay[1]), begin)
    z = _minus(resonant, _times(_minus(end, turned), inverse))
    # d/dτ of each part, from its definition.
    p, p_bar = (-xi, omega), (-xi, -omega)
    i_zeta = (jnp.zeros_like(zeta), zeta)
    rate_resonant = _times(p, resonant)
    rate_resonant = (rate_resonant[0] + end[0], rate_resonant[1] + end[1])
    rate_other = _minus(_times(i_zeta, end), _times(p_bar, turned))
    rate = _minus(rate_resonant, _times(rate_other, inverse))
    # Re{z / (2iω)} = Im{z} / (2ω)
    half = 0.5 / omega
    return half * z[1], half * rate[1]
