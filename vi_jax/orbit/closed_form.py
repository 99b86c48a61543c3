"""All motions with one impact per n drive cycles of the ideal scene, in closed form.

The paper's analysis (Eq. 14 to 21), for any damping ξ ≥ 0 and through resonance. Between impacts
Y'' + 2ξY' + Y = cos φ with φ' = ζ is linear in (Y, V, cos φ, sin φ). A flight over T = 2πn/ζ is
therefore a matrix, with blocks M (free motion) and G (response from rest). A motion with one impact
leaves the stop as (d, -k v) at phase φ0 and returns as (d, v):

    (d, v) = M (d, -k v) + G (cos φ0, sin φ0).

This gives cos φ0 and sin φ0 as affine functions of v, and cos² + sin² = 1 is a quadratic equation
for v, with at most two motions. With ξ = 0, A = 1/(1 - ζ²) and v0 = v/ζ (the velocity dY/dφ)

    sin φ0 = -(1 - k) v0/(2A),   cos φ0 = d/A + ζ (1 + k)/(2A) cot(nπ/ζ) v0.

The printed Eq. 21 lacks the factor ζ of the cosine and violates the boundary conditions (16) to
(18).
"""

from math import pi

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float, Int

from .._checks import count
from .._programs import compiled
from .._types import Flag, Number, Scalar
from ..flow import lack_of_closed_form
from ..machine import Shown
from ..machines import IdealDrive, OscillatorState, Scene
from .results import eigenvalues

# Grid points per drive cycle that bracket turning points: a choice, for ζ well above 1/256.
_POINTS = 256


class ClosedFormOrbits(Shown):
    """Motions with one impact per n cycles, in two places: admissible ones come first, then faster
    impacts. Places without a motion are NaN. Lengths in units of a, velocities of a ω."""

    Y: Float[Array, "... 2"]
    """Position on the scene's first section after the impact (φ = 0 mod 2π, or as set by
    `at_section`); d, just after the impact, if that falls on the section."""
    V: Float[Array, "... 2"]
    """dY/dτ on that section."""
    impact_phase: Float[Array, "... 2"]
    """Crank angle of the next impact (radians): in (2π(n - 1), 2πn] from the section on."""
    impact_speed: Float[Array, "... 2"]
    """dY/dτ just before the impact, positive."""
    y_min: Float[Array, "... 2"]
    """Smallest Y over the period."""
    y_max: Float[Array, "... 2"]
    """Largest Y over the period: the gap d, unless the motion leaves the gap."""
    clearance: Float[Array, "... 2"]
    """d - Y at the highest peak between impacts; +inf if there is no such peak."""
    multipliers: Complex[Array, "... 2 2"]
    """Floquet multipliers over the n cycles (last axis); their product is k² exp(-2ξT)."""
    admissible: Bool[Array, "... 2"]
    """True if the motion exists and stays inside the gap between impacts."""
    exists: Bool[Array, "... 2"]
    """True if the equations have this real solution and the body approaches the stop (v > 0)."""

    @property
    def state(self) -> OscillatorState:
        """The states on the section: a batch of starts, for `simulate` and `find_orbit`."""
        return OscillatorState(self.Y, self.V)


def closed_form_orbits(scene: Scene, *, cycles: int | Int[Array, ""] = 1) -> ClosedFormOrbits:
    """Return all motions of an ideal scene with one impact in `cycles` drive cycles (Eq. 14 to 21).

    **Arguments:** a `Scene` with an `IdealDrive`, a `CosineCrank` and one stop on the right, whose
    parameters are scalars, traced or not (for arrays use `jax.vmap`); the period in drive cycles.

    **Returns:** `ClosedFormOrbits`, stable and unstable motions alike. Differentiable if a motion
    exists; derivatives grow without bound towards a fold or a grazing. Resonance (ζ = 1, ξ = 0) is
    not special. If sin(nπ/ζ) = 0 with ξ = 0, the free motion is periodic itself, every motion has
    shrunk to a grazing, and none exists. Impacts slower than rounding can resolve count as grazing.
    Turning points are bracketed on 256 points per drive cycle and then solved for. With ζ near or
    below 1/256, peaks between the points can be missed.

    An impact may fall on the section: on φ = 0 it does with ξ = 0 and k = 1 or ζ = 1. The state is
    then that just after it, and the next impact is the last event of the period. If rounding would
    put it beyond the section, the last digits of V are changed. `simulate` counts an impact within
    rounding of the section before it.

    **Raises:** `ValueError` if the scene has no such closed form or `cycles` < 1.
    """
    reason = lack_of_closed_form(scene)
    if reason is not None:
        raise ValueError(f"Argument `scene` must be one with a closed form, a {reason}.")
    sides = [stop.side for stop in scene.stops]
    if sides != ["right"]:
        raise ValueError(
            f"Argument `scene` must have exactly one stop, on the right, but has stops {sides}."
        )
    stop = scene.stops[0]
    assert isinstance(scene.drive, IdealDrive)
    if not stop.is_one_number:
        raise ValueError(
            "Argument `scene` must have a stop with one number as its restitution, but has a law: "
            f"{stop!r}."
        )
    numbers = (scene.drive.frequency_ratio, scene.damping_ratio, stop.restitution, stop.gap)
    shapes = [jnp.shape(number) for number in numbers]
    if any(shapes):
        raise ValueError(
            "Argument `scene` must hold scalars (use `jax.vmap` for arrays), but its frequency "
            f"ratio, damping ratio, restitution and gap have shapes {shapes}."
        )
    section = 0.0 if scene.section_phase is None else scene.section_phase
    dtype = jnp.result_type(float, *numbers)
    *arrays, section = (jnp.asarray(x, dtype) for x in (*numbers, section))
    return _one_impact_orbits(*arrays, count("cycles", cycles, least=1), section)


def one_impact_orbits(
    zeta: Number, xi: Number, k: Number, d: Number, n: int, section: Number = 0.0
) -> ClosedFormOrbits:
    """Compute `closed_form_orbits` from dimensionless scalars; the period `n` is in drive cycles,
    `section` is a crank angle (radians)."""
    dtype = jnp.result_type(float, zeta, xi, k, d)
    zeta, xi, k, d, section = (jnp.asarray(x, dtype) for x in (zeta, xi, k, d, section))
    period = 2 * pi * n / zeta
    rates = _rates(zeta, xi)
    # Squarings of the flight over one grid step: over 1, 2, 4, … steps, and last over T. They hold
    # through resonance and critical damping, unlike sines and a steady response.
    doublings = (_POINTS * n - 1).bit_length()
    period_flight, flights = _squared(_exponential(rates * (period / 2**doublings)), doublings)
    v, phase, slack, resolved = _impacts(period_flight, k, d, period)

    # Absent motions are replaced by a harmless one, so that their derivatives cannot be NaN.
    exists = resolved & (v > 64 * jnp.finfo(dtype).eps * (1 + period) * (1 + jnp.abs(d)))
    v, phase = jnp.where(exists, v, 1.0), jnp.where(exists, phase, 1.0)
    follow = jax.vmap(lambda v, phase: _follow(rates, flights, period, k, d, v, phase))
    y_min, y_max, clearance = follow(v, phase)
    turn = jnp.mod(section - phase, 2 * pi)
    on_section = jax.lax.stop_gradient((turn <= slack) | (turn >= 2 * pi - slack))
    turn = turn - jax.lax.stop_gradient(jnp.where(on_section, turn, 0.0))
    start = _after_impact(k, d, v, phase)
    section_flight = _exponential(rates * (turn / zeta)[:, None, None] / 2**doublings, doublings)
    section_state = _dot(section_flight, start[..., None])[..., 0]
    nudge = jnp.where(on_section, _shift_before_section(period_flight, k, d, v, period), 0.0)

    multipliers = _multipliers(period_flight, xi, k, d, v, phase, period)
    admissible = exists & (clearance >= 0)

    def nan_if_absent(x):
        return jnp.where(exists, x, jnp.nan)

    orbits = ClosedFormOrbits(
        Y=nan_if_absent(section_state[:, 0]),
        V=nan_if_absent(section_state[:, 1] + nudge),
        impact_phase=nan_if_absent(section + 2 * pi * n - turn),
        impact_speed=nan_if_absent(v),
        y_min=nan_if_absent(y_min),
        y_max=nan_if_absent(y_max),
        clearance=nan_if_absent(clearance),
        multipliers=jnp.where(exists[:, None], multipliers, jnp.nan),
        admissible=admissible,
        exists=exists,
    )
    order = jnp.lexsort((-v, ~exists, ~admissible))
    return jax.tree.map(lambda x: x[order], orbits)


_one_impact_orbits = compiled(one_impact_orbits)


def _dot(a, b):
    # Without this accelerators may round the factors of a float32 product to fewer bits.
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)


def _exponential(matrix: Float[Array, "... 4 4"], doublings: int = 0) -> Float[Array, "... 4 4"]:
    """Return e^(2^doublings matrix), for norms up to 8, by Taylor's series and squaring: by
    products only, as the library's solver for batches of small systems may lock two threads."""
    identity = jnp.eye(matrix.shape[-1], dtype=matrix.dtype)
    small, first = matrix / 4, jnp.broadcast_to(identity, matrix.shape)
    # A loop compiles faster than the written-out series.
    total, _ = jax.lax.scan(
        lambda total, n: (identity + _dot(small, total) / n, None),
        first,
        jnp.arange(24, 0, -1, dtype=matrix.dtype),
    )
    return _squared(total, 2 + doublings)[0]


def _squared(
    matrix: Float[Array, "... n n"], times: int
) -> tuple[Float[Array, "... n n"], Float[Array, "times ... n n"]]:
    """Return matrix^(2^times), and the powers 1, 2, 4, … before it."""
    return jax.lax.scan(lambda m, _: (_dot(m, m), m), matrix, length=times)


def _rates(zeta: Scalar, xi: Scalar) -> Float[Array, "4 4"]:
    """Return the matrix of d/dτ (Y, V, cos φ, sin φ)."""
    constant = jnp.zeros((4, 4), zeta.dtype).at[0, 1].set(1).at[1, 0].set(-1).at[1, 2].set(1)
    return constant.at[1, 1].set(-2 * xi).at[2, 3].set(-zeta).at[3, 2].set(zeta)


def _after_impact(k, d, v, phase) -> Float[Array, "... 4"]:
    """Return (Y, V, cos φ, sin φ) just after the impact."""
    parts = jnp.broadcast_arrays(d, -k * v, jnp.cos(phase), jnp.sin(phase))
    return jnp.stack(parts, axis=-1)


def _impacts(
    flight: Float[Array, "4 4"], k: Scalar, d: Scalar, period: Scalar
) -> tuple[Float[Array, "2"], Float[Array, "2"], Float[Array, "2"], Flag]:
    """Return impact speeds (unit: a ω), impact phases in [0, 2π), the rounding error of these, and
    whether they are real. Let r(v) = f + g v = (d, v) - M (d, -k v) and G⁺ be the adjugate of G.
    The condition on the phase is then |G⁺ r(v)| = |det G|. Since det G⁺ = det G, the discriminant
    is det² (|G⁺ g|² - (f × g)²). Neither the speeds nor the test for real ones divide by det."""
    M, G = flight[:2, :2], flight[:2, 2:]
    f = jnp.stack([d - M[0, 0] * d, -M[1, 0] * d])
    g = jnp.stack([k * M[0, 1], 1 + k * M[1, 1]])
    adjugate = jnp.stack([jnp.stack([G[1, 1], -G[0, 1]]), jnp.stack([-G[1, 0], G[0, 0]])])
    det = G[0, 0] * G[1, 1] - G[0, 1] * G[1, 0]
    p, q = _dot(adjugate, f), _dot(adjugate, g)
    size = jnp.sum(q * q)
    radicand = size - (f[0] * g[1] - f[1] * g[0]) ** 2
    # Guarded on both sides of `where`, so that no derivative is infinite at a fold or beyond it.
    root = jnp.where(radicand > 0, jnp.sqrt(jnp.where(radicand > 0, radicand, 1.0)), 0.0)
    # A flight that is the identity to rounding (sin(nπ/ζ) = 0 with ξ = 0) determines no motion.
    noise = 16 * jnp.finfo(flight.dtype).eps * (1 + period)
    decided = size > noise**2
    v = (jnp.array([1.0, -1.0], det.dtype) * det * root - jnp.sum(p * q)) / jnp.where(
        decided, size, 1.0
    )
    resolved = (radicand >= 0) & decided
    direction = (p[:, None] + q[:, None] * v) * jnp.where(det < 0, -1.0, 1.0)
    cosine = jnp.where(resolved, direction[0], 1.0)
    phase = jnp.mod(jnp.arctan2(jnp.where(resolved, direction[1], 0.0), cosine), 2 * pi)
    # A rounding error below zero comes back from `mod` as a full turn.
    phase = jnp.where(phase >= 2 * pi, 0.0, phase)
    # The terms of v and of the phase cancel towards a grazing.
    length = jnp.sqrt(jnp.where(decided, size, 1.0))
    terms = 2 * jnp.sqrt(jnp.sum(p * p)) + jnp.abs(det) * root / length + length * jnp.abs(v)
    slack = 16 * noise * terms / jnp.where(resolved, jnp.hypot(*direction), 1.0)
    return v, phase, jax.lax.stop_gradient(jnp.minimum(slack, 1e3 * noise)), resolved


def _shift_before_section(flight, k, d, v, period) -> Float[Array, "2"]:
    """Return a change in the last digits of V just after the impact. With it the next impact comes
    before the section on which both fall, instead of where rounding puts it."""
    rounding = 64 * jnp.finfo(v.dtype).eps * (1 + period) * (1 + jnp.abs(d) + v)
    rise = flight[0, 1]
    change = rounding * rise / (rise * rise + 0.01)
    return jax.lax.stop_gradient(jnp.where(1e3 * jnp.abs(change) < k * v, change, 0.0))


def _follow(rates, flights, period, k, d, v, phase) -> tuple[Scalar, Scalar, Scalar]:
    """Return smallest and largest Y over the flight after the impact, and d - Y at the peak."""
    states = _after_impact(k, d, v, phase)[None]
    for flight in flights:  # over 1, 2, 4, … grid steps
        states = jnp.concatenate([states, _dot(states, flight.T)])
    end = jnp.stack([d, v, jnp.cos(phase), jnp.sin(phase)])  # the solved end
    states = jnp.concatenate([states, end[None]])
    y, w = states[:, 0], states[:, 1]
    h = period / (y.size - 1)
    # The place of w = 0 in its cell (linear) and Y there (cubic Hermite, fourth order).
    fall = w[:-1] - w[1:]
    share = jnp.clip(w[:-1] / jnp.where(fall == 0, 1.0, fall), 0, 1)
    rising, bulge = share * share * (3 - 2 * share), share * (1 - share)
    height = y[:-1] + rising * (y[1:] - y[:-1]) + h * bulge * ((1 - share) * w[:-1] - share * w[1:])
    has_peak, has_dip = (w[:-1] > 0) & (w[1:] <= 0), (w[:-1] < 0) & (w[1:] >= 0)

    def turning(here, sign):
        cell = jnp.argmax(jnp.where(here, sign * height, -jnp.inf))
        return _turning_point(rates, states[cell], share[cell] * h, h), jnp.any(here)

    peak, any_peak = turning(has_peak, 1.0)
    dip, any_dip = turning(has_dip, -1.0)
    y_min = jnp.where(any_dip, dip, jnp.min(y))
    y_max = jnp.where(any_peak, jnp.maximum(peak, d), d)
    return y_min, y_max, jnp.where(any_peak, d - peak, jnp.inf)


def _turning_point(rates, state, guess, h) -> Scalar:
    """Return Y where its velocity vanishes near `guess` after `state`, by Newton's method."""

    def motion_at(time, rates, state):
        state = _dot(_exponential(rates * time), state)
        acceleration = _dot(rates[1], state)
        return state[0], state[1], jnp.where(jnp.abs(acceleration) > 0, acceleration, 1.0)

    constants = jax.lax.stop_gradient((rates, state))

    def newton(_, time):
        _, velocity, acceleration = motion_at(time, *constants)
        return jnp.clip(time - velocity / acceleration, 0, jax.lax.stop_gradient(h))

    time = jax.lax.fori_loop(0, 3, newton, jax.lax.stop_gradient(guess))
    Y, velocity, acceleration = motion_at(time, rates, state)
    # To rounding this is Y; the last term makes its first and second derivatives correct too.
    return Y - 0.5 * velocity * velocity / acceleration


def _multipliers(flight, xi, k, d, v, phase, period) -> Complex[Array, "2 2"]:
    """Return the eigenvalues of saltation times flight; [motion, multiplier]. The saltation (δ
    before to δ after, at fixed time) is [[-k, 0], [(k a⁻ + a⁺)/V⁻, -k]]. Damping cancels in k a⁻ +
    a⁺ = (1 + k)(cos φ0 - d)."""
    kick = (1 + k) * (jnp.cos(phase) - d) / v
    half = 0.5 * (kick * flight[0, 1] - k * (flight[0, 0] + flight[1, 1]))
    det = jnp.broadcast_to(k * k * jnp.exp(-2 * xi * period), half.shape)
    return eigenvalues(half, det)
