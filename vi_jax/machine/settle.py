"""Contacts that push, stick, slip or open: one linear complementarity problem, in numbers.

For one state the rows J of contacts and frictions give the gains G = J M⁻¹ Jᵀ and the free rates b,
so that forces λ cause the rates a = G λ + b. Rows are ordered: normals, tangents, dry frictions.

    closed contact         0 ≤ a_n ⊥ λ_n ≥ 0
    given slip σ = ±1      λ_t = -σ μ λ_n, or -σ F for dry friction
    no slip                |λ_t| ≤ μ λ_n; a_t = 0 inside the bound, else λ_t opposes a_t

In an impact the rates are velocities: a_n = v_n⁺ + e v_n⁻ and a_t = v_t⁺ + e_t v_t⁻ (J. J. Moreau).
The condition without slip is that of D. E. Stewart and J. C. Trinkle (Int. J. Numer. Meth. Eng. 39,
1996). One contact has a closed form, few without friction nearly always an obvious solution;
otherwise Lemke's method solves the problem. R. W. Cottle, J.-S. Pang and R. E. Stone, The Linear
Complementarity Problem, 1992.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array

SOLVED, UNSOLVED, WORKING = 0.0, 1.0, 2.0

# Rows whose number would be below this many roundings after a pivot are ties, which the order of
# rows decides. With a threshold relative to each number, 16 % of planar problems of four contacts
# ended in rays that do not exist.
_TIES, _TIES_SINGLE = 4096.0, 64.0

# Shares below are relative to numbers that are known to at most this many roundings: a choice.
_ROUNDINGS = 64.0

# A closed contact opens if its rate exceeds this share of the rates' size: a redundant one is not
# pushed, but stays closed. Far above rounding, far below rates that open a contact.
_OPENS = 1e-9

# A body that a force sets in motion does not stick again at once: at this event its force equals
# the largest one to the accuracy of the event, which this share exceeds. A choice.
_RELEASED = 1e-6

# A foot below the centre of a body may carry it alone, while others touch without a force. They
# carry it if that foot is shorter: if its free rate is greater by this share of the rate that its
# force causes. A choice, far above ties and far below the rates of other motions.
_RAISED = 1e-6

# An impact gains energy if it gains more than this share of its work: some roundings.
_GAIN = 1e-12


def _share(share: float, x: Array) -> float:
    """Return a threshold, at least some roundings in the precision of `x`."""
    return max(share, _ROUNDINGS * float(jnp.finfo(x.dtype).eps))


def released_share(x: Array) -> float:
    """Return the share by which a force that has become too large exceeds friction at least, above
    ties in the precision of `x`."""
    return max(_RELEASED, 64 * _tie(x))


def _tie(x: Array) -> float:
    """Return the share of the largest number up to which numbers are ties."""
    roundings = _TIES if x.dtype == jnp.float64 else _TIES_SINGLE
    return roundings * float(jnp.finfo(x.dtype).eps)


class Contacts(NamedTuple):
    """The numbers of one question about n contacts, t of them with friction, and d dry frictions;
    m = n + t + d."""

    gains: Array
    """G, (m, m)."""
    rates: Array
    """b, (m,). That of a normal is positive if the contact opens."""
    friction: Array
    """μ of each tangent, (t,)."""
    closed: Array
    """True for contacts that are closed, (n,)."""
    slip: Array
    """The sign of each slip, (t + d,); 0 without slip."""
    level: Array
    """F, the force of each dry friction on a body that begins to slide, (d,)."""
    hold: Array
    """The largest force without slip divided by that of a slipping body, (t + d,)."""
    touches: Array | None = None
    """True for tangents of closed contacts, (t,), if several belong to one contact."""


class Settled(NamedTuple):
    """The answer to a question, without derivatives."""

    force: Array
    """λ, (m,)."""
    rate: Array
    """a, (m,)."""
    kept: Array
    """True for contacts that stay closed, (n,)."""
    spare: Array
    """True for contacts that others hold, such as the fourth leg of a table, (n,)."""
    mode: Array
    """For each friction its slip ±1, 0 for sticking, or ±¼ and ±¾ (see `Friction`), (t + d,)."""
    unsolved: Array
    """True if no solution was found."""


def lemke(matrix: Array, constant: Array) -> tuple[Array, Array, Array]:
    """Return the solution z of w = M z + q, w ⊥ z, both not negative; which z are basic; and
    `SOLVED` or `UNSOLVED`. Ties are decided lexicographically."""
    m, dtype = constant.shape[0], constant.dtype
    rows, columns = np.arange(m), np.arange(2 * m + 2)
    eps = float(jnp.finfo(dtype).eps)
    size = jnp.maximum(jnp.max(jnp.abs(matrix)), float(jnp.finfo(dtype).tiny))
    least, tie = _tie(constant), _tie(constant) * (1 + jnp.max(jnp.abs(constant)))
    # Columns: w, z, the artificial variable, the right side.
    parts = np.eye(m), -matrix, -np.ones((m, 1)), constant[:, None]
    table = jnp.concatenate([jnp.asarray(x, dtype) for x in parts], 1)

    def leaving(table: Array, column: Array, allowed: Array, artificial: Array) -> Array:
        scale = 1 / jnp.where(allowed, column, 1.0)
        wide = jnp.concatenate([table[:, -1:], table[:, :m]], 1) * scale[:, None]

        def narrow(state: tuple) -> tuple:
            k, is_left, _ = state
            x = jnp.sum(jnp.where(np.arange(m + 1)[None, :] == k, wide, 0.0), 1)
            best = jnp.min(jnp.where(is_left > 0, x, jnp.inf))
            is_left = jnp.where((is_left > 0) & ((x - best) * column <= tie), 1.0, 0.0)
            # The artificial variable leaves as soon as it may.
            ends = (k == 0) & (jnp.sum(is_left * artificial) > 0)
            is_left = jnp.where(ends, is_left * artificial, is_left)
            return k + 1.0, is_left, jnp.sum(is_left)

        zero = jnp.zeros((), dtype)
        begin = zero, jnp.where(allowed, 1.0, zero), zero + m
        _, is_left, _ = jax.lax.while_loop(lambda x: (x[0] <= m) & (x[2] > 1.5), narrow, begin)
        return jnp.min(jnp.where(is_left > 0, rows * 1.0, m))

    # The first pivot: the most negative q. The last of ties keeps rows lexicographically positive.
    lowest = jnp.min(constant)
    first = jnp.max(jnp.where(constant <= lowest * (1 - 16 * eps), rows * 1.0, 0.0))

    def step(state: tuple) -> tuple:
        table, basis, entering, _, count = state
        column = jnp.sum(jnp.where((columns == entering)[None, :], table, 0.0), 1)
        allowed = column > least * jnp.maximum(size, jnp.max(jnp.abs(column)))
        is_ray = ~jnp.any(allowed) & (count > 0)
        row = leaving(table, column, allowed, jnp.where(basis == 2 * m, 1.0, 0.0))
        is_row = (rows == jnp.where(count == 0, first, row)) & ~is_ray
        chosen = jnp.sum(jnp.where(is_row[:, None], table, 0.0), 0)
        pivot = jnp.sum(jnp.where(is_row, column, 0.0))
        chosen = chosen / jnp.where(is_ray, 1.0, pivot)
        table = jnp.where(is_row[:, None], chosen, table - column[:, None] * chosen)
        left = jnp.sum(jnp.where(is_row, basis, 0.0))
        basis = jnp.where(is_row, entering, basis)
        code = jnp.where(left == 2 * m, SOLVED, jnp.where(count > 10 * m + 20, UNSOLVED, WORKING))
        complement = jnp.where(left < m, left + m, left - m)
        return table, basis, complement, jnp.where(is_ray, UNSOLVED, code), count + 1.0

    zero = jnp.zeros((), dtype)
    code = jnp.where(lowest < 0, WORKING, SOLVED).astype(dtype)
    begin = table, rows * (1 + zero), 2.0 * m + zero, code, zero
    table, basis, _, code, _ = jax.lax.while_loop(lambda x: x[3] == WORKING, step, begin)
    is_z = basis[None, :] == (m + rows)[:, None]
    return jnp.sum(jnp.where(is_z, table[:, -1], 0.0), 1), jnp.any(is_z, 1), code


def solve_modes(matrix: Array, right: Array) -> Array:
    """Solve a linear system by elimination with pivots of rows; vector code and derivatives run."""
    m = right.shape[0]
    rows, columns = np.arange(m), np.arange(m + 1)

    def step(state: tuple, k: Array) -> tuple[tuple, None]:
        table, used, place = state
        column = jnp.sum(jnp.where((columns == k)[None, :], table, 0.0), 1)
        size = jnp.where(used > 0, -1.0, jnp.abs(stop_gradient(column)))
        row = jnp.min(jnp.where(size == jnp.max(size), rows * 1.0, m))
        is_row = rows == row
        pivot = jnp.sum(jnp.where(is_row, column, 0.0))
        chosen = jnp.sum(jnp.where(is_row[:, None], table, 0.0), 0)
        chosen = chosen / jnp.where(pivot == 0, 1.0, pivot)
        table = jnp.where(is_row[:, None], chosen, table - column[:, None] * chosen)
        return (table, jnp.where(is_row, 1.0, used), jnp.where(is_row, k, place)), None

    zeros = jnp.zeros((m,), right.dtype)
    begin = jnp.concatenate([matrix, right[:, None]], 1), zeros, zeros
    (table, _, place), _ = jax.lax.scan(step, begin, jnp.arange(m, dtype=right.dtype))
    return jnp.sum(jnp.where(place[None, :] == rows[:, None], table[None, :, -1], 0.0), 1)


def _diagonal(matrix: Array) -> Array:
    """Return the diagonal; vector code runs."""
    return jnp.sum(matrix * np.eye(len(matrix)), 1)


def _scaled(x: Contacts) -> tuple[Contacts, Array, Array]:
    """Return the question with rows in units of their gain, and rates in units of the largest; the
    units of the rows; and that of the rates."""
    n, t = x.closed.shape[0], x.friction.shape[0]
    own = _diagonal(x.gains)
    unit = 1 / jnp.sqrt(jnp.where(own > 0, own, 1.0))
    top = jnp.maximum(jnp.max(jnp.abs(x.rates * unit)), float(jnp.finfo(unit.dtype).tiny))
    if x.level.shape[0]:
        top = jnp.maximum(top, jnp.max(jnp.abs(x.level / unit[n + t :])))
    scaled = x._replace(
        gains=x.gains * unit[:, None] * unit, rates=x.rates * unit / top,
        level=x.level / (unit[n + t :] * top),
    )  # fmt: skip
    return scaled, unit, top


def _normals(x: Contacts, of: tuple[int, ...]) -> np.ndarray:
    """Return which normal each tangent belongs to, (t + d, n); `of` has the normals' numbers."""
    matrix = np.zeros((x.slip.shape[0], x.closed.shape[0]))
    matrix[np.arange(len(of)), list(of)] = 1.0
    return matrix


class _Decided(NamedTuple):
    pushes: Array
    """True for contacts that push, (n,)."""
    holds: Array
    """True for frictions that hold, (t + d,)."""
    mode: Array
    """The slip of each other friction, or 0 without a force, (t + d,)."""
    force: Array
    """(m,)."""
    code: Array


def _decide(x: Contacts, of: tuple[int, ...]) -> _Decided:
    x = stop_gradient(x)
    n, t, all_t = x.closed.shape[0], len(of), x.slip.shape[0]
    normal_of, dtype = _normals(x, of), x.rates.dtype
    x, unit, top = _scaled(x)
    ratio = normal_of @ unit[:n] / unit[n:] if n else jnp.zeros((all_t,), dtype)
    friction = jnp.concatenate([x.friction, jnp.zeros((all_t - t,), dtype)]) * ratio
    coupling = normal_of * friction[:, None]
    touches = (normal_of @ jnp.where(x.closed, 1.0, 0.0))[:t] > 0
    touches = touches if x.touches is None else touches & x.touches
    free = jnp.concatenate([touches, jnp.ones((all_t - t,), bool)]) & (x.slip == 0)
    # A slipping contact's push includes its friction; that of a sliding dry friction is known.
    dragged = x.gains[:, :n] - x.gains[:, n:] @ (coupling * x.slip[:, None])
    known = jnp.concatenate([jnp.zeros((t,), dtype), -x.slip[t:] * x.level])
    rates = x.rates + x.gains[:, n:] @ known
    tangents, one = x.gains[n:, n:], jnp.eye(all_t, dtype=dtype)
    across = x.gains[:n, n:]
    none = jnp.zeros((n, all_t), dtype)
    blocks = [
        [dragged[:n], across, -across, none],
        [dragged[n:], tangents, -tangents, one],
        [-dragged[n:], -tangents, tangents, one],
        [coupling, -one, -one, 0 * one],
    ]
    bound = jnp.concatenate([jnp.zeros((t,), dtype), x.level]) * x.hold
    constant = jnp.concatenate([rates[:n], rates[n:], -rates[n:], bound])
    if t:  # the largest force without slip
        coupling = coupling * x.hold[:, None]
        blocks[3][0] = coupling
    matrix = jnp.concatenate([jnp.concatenate(row, 1) for row in blocks])
    # A variable that takes no part: w = z + 1.
    acts = jnp.concatenate([x.closed, free, free, free])
    matrix = jnp.where(acts[:, None] & acts, matrix, np.eye(n + 3 * all_t))
    z, basic, code = lemke(matrix, jnp.where(acts, constant, 1.0))
    pushes, (forward, backward, at_bound) = basic[:n], jnp.split(basic[n:], 3)
    holds = free & jnp.where(at_bound, forward & backward, forward != backward)
    slips = free & at_bound & (forward != backward)
    # Without a force: no direction yet.
    mode = jnp.where(slips, jnp.where(forward, -1.0, 1.0), x.slip)
    tangent = z[n : n + all_t] - z[n + all_t : n + 2 * all_t]
    given = known - x.slip * (normal_of * friction[:, None] @ z[:n])
    force = jnp.concatenate([z[:n], jnp.where(free, tangent, given)]) * unit * top
    return _Decided(pushes, holds, mode, force, code)


def forces_in(
    x: Contacts, of: tuple[int, ...], pushes: Array, holds: Array, mode: Array
) -> Array:  # fmt: skip
    """Return the forces λ, (m,), with derivatives, if these contacts push, these frictions hold,
    and the others slip as in `mode`, or have no force where it is 0."""
    n, d = x.closed.shape[0], x.level.shape[0]
    tangents = jnp.concatenate([x.friction, jnp.zeros((d,), x.rates.dtype)])
    slip = jnp.where(holds, 0.0, mode)
    tie = jnp.pad((slip * tangents)[:, None] * _normals(x, of), ((n, 0), (0, slip.shape[0])))
    t = slip.shape[0] - d
    known = jnp.concatenate([jnp.zeros((n + t,), x.rates.dtype), -slip[t:] * x.level])
    held = jnp.concatenate([pushes, holds])
    matrix = jnp.where(held[:, None], x.gains, np.eye(x.rates.shape[0]) + tie)
    return solve_modes(matrix, jnp.where(held, -x.rates, known))


# So many rows without friction on contacts are settled without Lemke's method first: a choice.
_FEW = 4

# A row that depends on others to this share of its gain is redundant: a choice.
_REDUNDANT = 1e-9


def _redundant(gains: Array, first: Array, still: Array) -> Array:
    """Return which rows depend linearly on the `first` ones, or are `still` and depend on these
    and on one before that is still, too."""
    gains, rows = stop_gradient(gains), np.arange(gains.shape[0])
    own = _diagonal(gains)
    zeros, least = jnp.zeros((len(rows),), gains.dtype), _share(_REDUNDANT, gains) * own
    takes = jnp.stack([first, still])

    def step(state: tuple, given: tuple) -> tuple[tuple, Array]:
        table, found = state
        row, takes = given
        here = rows == row
        column = jnp.sum(jnp.where(here, table, 0.0), 1)
        pivot = jnp.sum(jnp.where(here, column, 0.0))
        counts = here & takes & (pivot > least)
        any_counts = jnp.any(counts)
        change = column[:, None] * jnp.sum(jnp.where(here[:, None], table, 0.0), 0)
        change = change / jnp.where(any_counts, pivot, 1.0)
        table = jnp.where(any_counts, table - change, table)
        return (table, jnp.where(counts, 1.0, found)), _diagonal(table)

    order = np.tile(rows, 2) * 1.0, jnp.repeat(takes, len(rows), 0)
    carry, left = jax.lax.scan(step, (gains, zeros), order)
    return (carry[1] == 0) & (jnp.where(still, left[-1], left[len(rows) - 1]) <= least)


def settle(x: Contacts, of: tuple[int, ...] = (), *, has_ratios: bool = True) -> Settled:
    """Return which contacts push, stick, slip or open, and their forces. **Arguments:** `of`, the
    number of each tangent's contact; `has_ratios`, whether some `hold` is not 1.

    A friction whose largest force without slip exceeds that of a slipping body is asked again with
    the slip that it begins, until no other begins to slip. Of several sets of contacts that carry a
    body, one is found in which each pushes.
    """
    x, n = stop_gradient(x), x.closed.shape[0]
    if x.rates.shape == (1,):
        return _settle_one(x)

    def decide(x: Contacts) -> _Decided:
        if of == (0,) and len(x.rates) == 2:
            return _decide_one(x)
        if not of and len(x.rates) <= _FEW:
            return _decide_quickly(x)
        return _decide_in_turn(x, of, has_ratios)

    if n < 3:
        return _settled(x, of, decide(x))[0]
    normals = np.arange(len(x.rates)) < n

    def ask(state: tuple) -> tuple:
        old, raised, count = state
        found, is_first = decide(x._replace(rates=x.rates + raised)), count == 0
        force = forces_in(x, of, found.pushes, found.holds, found.mode)
        force = jnp.where(is_first, found.force, force)
        new, idle = _settled(x, of, found._replace(force=force))
        better = is_first | ~(new.unsolved | jnp.any(idle))
        raised = jnp.where(normals, _RAISED * _diagonal(x.gains) * force, 0.0)
        again = is_first & jnp.any(idle) & jnp.any(new.spare)
        new = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, old)
        return new, raised, jnp.where(again, 1.0, 2.0)

    nothing = Settled(x.rates, x.rates, x.closed, x.closed, x.slip, jnp.zeros((), bool))
    begin = nothing, 0 * x.rates, jnp.zeros((), x.rates.dtype)
    return jax.lax.while_loop(lambda state: state[2] < 2, ask, begin)[0]


def _settled(x: Contacts, of: tuple[int, ...], found: _Decided) -> tuple[Settled, Array]:
    """Return the answer of `settle`, and for each contact whether it stays closed without a force,
    though no others hold it."""
    n = x.closed.shape[0]
    pushed = x.gains @ found.force
    rate = pushed + x.rates
    size = jnp.max(jnp.abs(x.rates)) + jnp.max(jnp.abs(pushed))
    moves = jnp.where(jnp.abs(rate) > _share(_OPENS, rate) * size, jnp.sign(rate), 0.0)
    still = ~found.holds & (x.slip == 0) & (moves[n:] == 0)
    # A slip without a force goes where it is accelerated.
    mode = jnp.where(~found.holds & (found.mode == 0), moves[n:], found.mode)
    kept = x.closed & (found.pushes | (moves[:n] <= 0))
    spare, idle, force = x.closed & False, x.closed & False, found.force
    if n > 1 or x.slip.shape[0] > 1:
        pushes, acts, t = found.pushes, found.holds, len(of)
        if n:  # a contact that is about to open is not pushed, but for rounding
            own = _diagonal(x.gains)[:n]
            pushes = pushes & (own * found.force[:n] > _share(_OPENS, rate) * size)
            force = found.force.at[:n].set(jnp.where(pushes, found.force[:n], 0.0))
        if of:  # a contact that is not pushed has no friction
            on = _normals(x, of)[:t] @ jnp.where(pushes, 1.0, jnp.zeros_like(rate[:n]))
            acts = acts.at[:t].set(acts[:t] & (on > 0))
        first = jnp.concatenate([pushes, acts])
        known = jnp.concatenate([kept & ~pushes, still & (mode == 0)])
        asked = jnp.concatenate([~pushes, still])
        redundant = jax.lax.cond(
            jnp.any(asked), lambda: _redundant(x.gains, first, known) & asked, lambda: asked
        )
        spare = redundant[:n]
        idle = kept & ~pushes & ~spare
        # Others hold a redundant friction, which keeps its largest force, or none.
        held = still & redundant[n:]
        mode = jnp.where(held, jnp.where(mode == 0, 0.25, 0.75 * mode), mode)
    return Settled(force, rate, kept, spare, mode, found.code != SOLVED), idle


def _decide_quickly(x: Contacts) -> _Decided:
    """Return `_decide_in_turn` without friction on contacts. If the rows that may act are
    independent, there is one solution. So it is found if all contacts push and all frictions hold
    that may, or all but one, which opens or begins to slip. Other cases and ties are left to
    Lemke's method, which took as long as all of the step at each event of two frictions."""
    n, free, bound = x.closed.shape[0], x.slip == 0, x.hold * x.level
    own = _diagonal(x.gains)[:n]

    def compare(force: Array, largest: Array) -> tuple[Array, Array]:
        tie = _tie(force) * (largest + jnp.max(jnp.abs(force)))
        force = jnp.abs(force[n:])
        return force - largest > tie, largest - force > tie

    def solved(pushes: Array, slip: Array, level: Array) -> Array:
        return forces_in(x._replace(level=level), (), pushes, slip == 0, slip)

    held = solved(x.closed, x.slip, x.level)
    above, below = compare(held, bound)
    above, pushes = free & above, x.closed & (held[:n] > 0)
    slip = jnp.where(above, -jnp.sign(held[n:]), x.slip)
    # The force of the one that begins to slip is first the largest one, then that of a slip.
    largest = solved(pushes, slip, jnp.where(above, bound, x.level))
    sliding = solved(pushes, slip, x.level)
    stays, opens = free & ~above, x.closed & ~pushes
    rate = x.gains @ sliding + x.rates
    size = jnp.max(jnp.abs(x.rates)) + jnp.max(jnp.abs(rate - x.rates))
    least = 2 * released_share(rate) * size
    acts = jnp.concatenate([x.closed, free])
    sure = _are_independent(jnp.where(acts[:, None] & acts, x.gains, np.eye(acts.shape[0])))
    sure = sure & jnp.all(below | ~stays)
    sure = sure & (jnp.sum(jnp.where(jnp.concatenate([opens, above]), 1.0, 0.0)) <= 1)
    for force in (largest, sliding):
        sure = sure & jnp.all(compare(force, bound)[1] | ~stays)
        sure = sure & jnp.all((own * force[:n] > least) | ~pushes)
    sure = sure & jnp.all((rate[:n] > least) | ~opens)
    sure = sure & jnp.all((rate[n:] * slip >= -least) | ~above)  # else it is asked anew
    found = _Decided(pushes, stays, slip, sliding, jnp.zeros_like(size))
    return jax.lax.cond(sure, lambda: found, lambda: _decide_in_turn(x, (), bool(len(x.level))))


def _are_independent(gains: Array) -> Array:
    """Return whether no row depends on others, by the pivots of elimination."""
    left, independent = gains, jnp.ones((), bool)
    least = _share(_REDUNDANT, gains)
    for i in range(len(gains)):
        independent = independent & (left[i, i] > least * gains[i, i])
        pivot = jnp.where(left[i, i] > 0, left[i, i], 1.0)
        left = left - left[:, i, None] * left[i] / pivot
    return independent


def _decide_in_turn(x: Contacts, of: tuple[int, ...], has_ratios: bool) -> _Decided:
    """Frictions begin to slip one by one, the fastest first: the less force of one may hold the
    others. One that would then be accelerated against its slip is asked anew."""
    if not has_ratios:
        return _decide(x, of)
    n, rows = x.closed.shape[0], np.arange(x.slip.shape[0])
    own = _diagonal(x.gains)[n:]

    def ask(state: tuple) -> tuple:
        slip, _, _, count = state
        new = _decide(x._replace(slip=slip), of)
        pushed = x.gains @ new.force
        size, rate = jnp.max(jnp.abs(x.rates)) + jnp.max(jnp.abs(pushed)), (pushed + x.rates)[n:]
        returns = (slip != x.slip) & (rate * slip < -2 * released_share(rate) * size)
        begins = (new.mode != slip) & (x.hold != 1) & (new.code == SOLVED) & ~jnp.any(returns)
        pace = jnp.where(begins, rate * rate / jnp.where(own > 0, own, 1.0), -1.0)
        first = begins & (rows == jnp.min(jnp.where(pace == jnp.max(pace), rows, len(rows))))
        again = jnp.any(begins | returns) & (count < 3 * slip.shape[0])
        slip = jnp.where(returns, x.slip, jnp.where(first, new.mode, slip))
        return slip, new, jnp.where(again, 1.0, 0.0), count + 1.0

    zero = jnp.zeros((), x.rates.dtype)
    nothing = _Decided(x.closed, x.slip > 0, x.slip, x.rates, zero)
    begin = x.slip, nothing, zero + 1, zero
    return jax.lax.while_loop(lambda state: state[2] > 0, ask, begin)[1]


def _settle_one(x: Contacts) -> Settled:
    """Return `settle` of a single contact or dry friction: its problem has a closed form."""
    needed, none = -x.rates / x.gains[0], jnp.zeros((), bool)
    if not x.level.shape[0]:
        force = jnp.where(x.closed, jnp.maximum(needed, 0.0), 0.0)
        kept = x.closed & (needed >= 0)
        return Settled(force, x.rates + x.gains[0] * force, kept, x.closed & False, x.slip, none)
    slip = jnp.where(jnp.abs(needed) <= x.hold * x.level, 0.0, -jnp.sign(needed))
    mode = jnp.where(x.slip != 0, x.slip, slip)
    force = jnp.where(mode == 0, needed, -mode * x.level)
    return Settled(force, x.rates + x.gains[0] * force, x.closed, x.closed, mode, none)


class _Planar(NamedTuple):
    """The gains of a contact with one friction: its normal row's and its tangent's own, the rate of
    the normal by the tangent's force and the reverse, and μ."""

    normal: Array
    tangent: Array
    gain: Array
    back: Array
    level: Array

    def with_slip(self, sign: Array | float, wanted: Array) -> Array:
        """Return the push that gives the normal this rate with the friction of a given slip."""
        return wanted / (self.normal - sign * self.level * self.gain)

    def without_slip(
        self, wanted: Array, stop: Array, hold: Array | float = 1.0
    ) -> tuple[Array, Array, Array, Array]:
        """Return push and friction that give the wanted rates, whether the body sticks, and the
        direction of its slip otherwise."""
        det = self.normal * self.tangent - self.gain * self.back
        det = jnp.where(det == 0, 1.0, det)
        push = (self.tangent * wanted - self.gain * stop) / det
        drag = (self.normal * stop - self.back * wanted) / det
        forward, backward = (self.with_slip(sign, wanted) for sign in (1.0, -1.0))
        # Whether the body slips forward, with the friction against it. The stop cannot pull: if its
        # push would be negative so, the body slips backward.
        goes = (self.back - self.level * self.tangent) * forward - stop > 0
        is_forward = (forward >= 0) & goes
        slips = jnp.where(is_forward, forward, backward)
        sign = jnp.where(is_forward, 1.0, -1.0)
        stays = jnp.abs(drag) <= hold * self.level * jnp.maximum(push, 0.0)
        stays = stays & (self.tangent > 0)
        pushes = jnp.where(stays, push, slips)
        return pushes, jnp.where(stays, drag, -sign * self.level * slips), stays, sign


def _decide_one(x: Contacts) -> _Decided:
    """Return `_decide` of a single contact with friction, in closed form."""
    (normal, gain), (back, tangent) = x.gains
    planar = _Planar(normal, tangent, gain, back, x.friction[0])
    (wanted, stop), given, hold = -x.rates, x.slip[0], x.hold[0]
    slides, presses = given != 0, x.closed[0] & (wanted > 0)
    push, drag, stays, sign = planar.without_slip(wanted, stop, hold)
    pushed = planar.with_slip(given, wanted)
    push = jnp.where(slides, pushed, push)
    drag = jnp.where(slides, -given * planar.level * pushed, drag)
    unsolved = presses & ~((push >= 0) & (push < jnp.inf))
    presses = presses & ~unsolved
    force, holds = jnp.where(presses, jnp.stack([push, drag]), 0.0), presses & stays & ~slides
    mode = jnp.where(slides | ~presses | holds, given, sign)
    code = jnp.where(unsolved, UNSOLVED, jnp.zeros_like(push))
    return _Decided(presses[None], holds[None], mode[None], force, code)


class Blow(NamedTuple):
    """The result of impacts on several contacts at once."""

    impulse: Array
    """(n + t,)."""
    share: Array
    """θ, the share of the restitution: less than 1 where Newton's and Coulomb's laws together would
    gain energy."""
    unsolved: Array


class Strike(NamedTuple):
    """The numbers of an impact on n contacts, t of them with friction."""

    gains: Array
    """(n + t, n + t)."""
    velocity: Array
    """Before the impact, (n + t,); that of a normal is negative if the contact closes."""
    friction: Array
    """(t,)."""
    restitution: Array
    """(n,)."""
    tangential: Array
    """(t,)."""
    struck: Array
    """True for the contacts that take part, (n,)."""


def strike(x: Strike, of: tuple[int, ...]) -> Blow:
    """Return the impact of the contacts `struck` together, by Moreau's law.

    Newton's law and Coulomb's may gain energy together (T. R. Kane). Impulses without restitution
    never do, and both satisfy the conditions of contact, which are convex. Then the result is the
    mean of both with the largest share θ of restitution that gains none.
    """
    several = jnp.sum(jnp.where(x.struck, 1.0, 0.0)) > 1
    one = _strike_one(x, of)
    if x.struck.shape[0] == 1:
        return one
    return jax.lax.cond(several, lambda: _strike_together(x, of), lambda: one)


def _strike_together(x: Strike, of: tuple[int, ...]) -> Blow:
    n, none = x.struck.shape[0], jnp.zeros((len(of),), x.velocity.dtype)

    def moreau(_: None, share: Array) -> tuple[None, tuple[Array, Array]]:
        closing = share * x.restitution * jnp.minimum(x.velocity[:n], 0.0)
        target = jnp.concatenate([closing, share * x.tangential * x.velocity[n:]])
        question = Contacts(
            x.gains, x.velocity + target, x.friction, x.struck, none, none[:0], none + 1
        )
        found = _decide(question, of)
        force = forces_in(question, of, found.pushes, found.holds, found.mode)
        return None, (force, found.code)

    shares = jnp.asarray([0.0, 1.0], x.velocity.dtype)
    _, ((inelastic, full), codes) = jax.lax.scan(moreau, None, shares)
    return _without_gain(x, inelastic, jnp.where(codes[1] == SOLVED, full, inelastic), codes[0])


def _strike_one(x: Strike, of: tuple[int, ...]) -> Blow:
    """Return the impact of one contact, in closed form."""
    n, here = x.struck.shape[0], jnp.where(x.struck, 1.0, 0.0)
    restitution = jnp.sum(here * x.restitution)
    speed = jnp.sum(here * x.velocity[:n])
    across = jnp.sum(here[:, None] * x.gains[:n], 0)  # the row of the struck contact
    normal = jnp.sum(here * across[:n])
    zeros, code = jnp.zeros_like(x.velocity), jnp.zeros((), x.velocity.dtype)
    if not of:
        impulse = here * (-(1 + restitution) * speed / normal)
        return Blow(impulse, jnp.ones_like(speed), code != SOLVED)
    along = here[np.asarray(of)]
    slip, kept = (jnp.sum(along * y) for y in (x.velocity[n:], x.tangential))
    gain, both = jnp.sum(along * across[n:]), jnp.sum(along[:, None] * x.gains[n:], 0)
    back, tangent = jnp.sum(here * both[:n]), jnp.sum(along * both[n:])
    planar = _Planar(normal, tangent, gain, back, jnp.sum(along * x.friction))

    def impulses(share: float) -> Array:
        wanted = -(1 + share * restitution) * speed, -(1 + share * kept) * slip
        push, drag, _, _ = planar.without_slip(*wanted)
        return zeros.at[:n].set(here * push).at[n:].set(along * drag)

    return _without_gain(x, impulses(0.0), impulses(1.0), code)


def _without_gain(x: Strike, inelastic: Array, full: Array, code: Array) -> Blow:
    """Return the mean of two impulses with the largest share of the second that gains no energy."""
    change = full - inelastic
    # The energy gained with the share θ: c0 + c1 θ + c2 θ², where c0 ≤ 0.
    c0 = jnp.dot(inelastic, x.velocity) + 0.5 * jnp.dot(inelastic, x.gains @ inelastic)
    c1 = jnp.dot(change, x.velocity + x.gains @ inelastic)
    c2 = 0.5 * jnp.dot(change, x.gains @ change)
    size = jnp.abs(jnp.dot(inelastic, x.velocity)) + jnp.abs(jnp.dot(full, x.velocity))
    gains = stop_gradient(c0 + c1 + c2) > _share(_GAIN, size) * stop_gradient(size)
    root = jnp.sqrt(jnp.where(gains, jnp.maximum(c1 * c1 - 4 * c0 * c2, 0.0), 1.0))
    stable = -2 * c0 / jnp.where(gains & (c1 > 0), c1 + root, 1.0)
    other = (root - c1) / jnp.where(gains, 2 * c2, 1.0)
    share = jnp.where(gains, jnp.clip(jnp.where(c1 > 0, stable, other), 0.0, 1.0), 1.0)
    impulse = jnp.where(gains, inelastic + share * change, full)
    return Blow(impulse, share, code != SOLVED)
