"""Independent reference solutions: motions with impacts, chatter and rest, without the package.

`flown` computes many ideally driven lanes at once in closed form, with NumPy. It finds every root
between the zeros of the next higher derivative. `integrated` computes one machine, with ideal drive
or motor, with SciPy's `solve_ivp`. It takes short steps, and searches for a contact only after the
body has turned towards the stop.

Chatter is completed when its remaining time is below 1e-6. The body then rests until the force on
it falls through zero.
"""

from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

# Remaining time of a chatter when it is completed; the error is of second order. Hops lower than
# rounding (FLAT) are completed too, unless they take longer than LONG.
BRIEF, FLAT, LONG = 1e-6, 1e-13, 1e-3
LATE, ROUNDING = 1e-12, 4e-15
ULP = np.finfo(float).eps


class Truth(NamedTuple):
    """Results; arrays have a trailing axis of lanes in `flown`, but not in `integrated`."""

    sections: np.ndarray
    """(cycles + 1, Y and V (and W)): the states on the sections."""
    y_min: np.ndarray
    """(cycles,): smallest Y in each cycle."""
    y_max: np.ndarray
    impacts: np.ndarray
    """(cycles,): impacts, without those of completed chatters."""
    rests: np.ndarray
    """(cycles,): how often the body came to rest."""


class _Flight:
    """Y(τ) = Re{c e^(pτ) + F e^(iζτ)} and its derivatives for many lanes; needs ξ < 1."""

    def __init__(self, zeta, xi, phase, Y, V):
        forced = np.exp(1j * phase) / (1 - zeta * zeta + 2j * xi * zeta)
        y = Y - forced.real
        v = V - (1j * zeta * forced).real
        p = -xi + 1j * np.sqrt(1 - xi * xi)
        self.rates = np.array([p, 1j * zeta])
        self.begin = np.array([y - 1j * (v + xi * y) / p.imag, forced])

    def terms(self, tau, lanes=slice(None)):
        """Return c e^(pτ) and F e^(iζτ) at times since the start for all or some lanes."""
        return self.begin[:, lanes] * np.exp(self.rates[:, lanes] * tau)

    def derivative(self, order, terms, lanes=slice(None)):
        """Return the derivative of this order from the values of the two terms."""
        for _ in range(order):
            terms = terms * self.rates[:, lanes]
        return terms.real.sum(axis=0)

    def root(self, order, low, high, lanes, offset=0.0):
        """Return the times at which a derivative equals `offset`. Newton's method is replaced by
        bisection if a step leaves the bracket or is more than half of the last step."""
        at_end = self.derivative(order, self.terms(high, lanes), lanes)
        offset = np.broadcast_to(offset, high.shape)
        sign = np.sign(at_end - offset)
        low, high, found = low.copy(), high.copy(), 0.5 * (low + high)
        step = high - low
        size = abs(self.begin[:, lanes] * self.rates[:, lanes] ** order).sum(axis=0) + abs(offset)
        left = np.arange(high.size)
        while left.size:
            time, mine = found[left], lanes[left]
            terms = self.terms(time, mine)
            value = self.derivative(order, terms, mine) - offset[left]
            slope = self.derivative(order + 1, terms, mine)
            beyond = value * sign[left] > 0
            high[left] = np.where(beyond, time, high[left])
            low[left] = np.where(beyond, low[left], time)
            with np.errstate(divide="ignore", invalid="ignore"):
                new = time - value / slope
            newton = (
                (abs(new - time) <= 0.5 * step[left]) & (low[left] <= new) & (new <= high[left])
            )
            new = np.where(newton, new, 0.5 * (low[left] + high[left]))
            new = np.where(abs(value) <= ULP * size[left], time, new)
            step[left], found[left] = abs(new - time), new
            left = left[step[left] > ULP * new]
        return found

    def pieces(self, length):
        """Return times (points, lanes) between which Y is monotone, and Y there. They come from the
        zeros of Y''', Y'' and Y'."""
        times, terms = [np.zeros_like(length), length], [self.begin, self.terms(length)]
        for order in (3, 2, 1):
            values = [self.derivative(order, x) for x in terms]
            finer, there = times[:1], terms[:1]
            for i in range(len(times) - 1):
                turn, at_turn = times[i].copy(), terms[i].copy()
                turns = np.flatnonzero(values[i] * values[i + 1] < 0)
                turn[turns] = self.root(order, times[i][turns], times[i + 1][turns], turns)
                at_turn[:, turns] = self.terms(turn[turns], turns)
                finer, there = [*finer, turn, times[i + 1]], [*there, at_turn, terms[i + 1]]
            times, terms = finer, there
        return np.array(times), np.array([self.derivative(0, x) for x in terms])


def flown(zeta, xi, stops, Y, V, cycles, *, section=0.0, fineness=32):
    """Compute the ideally driven oscillator (cosine crank) for `cycles` drive cycles.

    **Arguments:** ζ, ξ < 1 (not both at resonance), a tuple of (sign, gap, k), and the state on the
    section at crank angle `section`; each is a number or an array of lanes. `fineness` is the
    number of search intervals in the shorter of the two periods.

    **Returns:** a `Truth`.
    """
    numbers = [x for _, gap, k in stops for x in (gap, k)]
    arrays = np.broadcast_arrays(*(np.atleast_1d(np.asarray(x, float)) for x in (
        zeta, xi, Y, V, section, *numbers)))  # fmt: skip
    zeta, xi, Y, V, section, *numbers = (x.copy() for x in arrays)
    stops = [(sign, numbers[2 * i], numbers[2 * i + 1]) for i, (sign, *_) in enumerate(stops)]
    lanes = zeta.size
    look = 2 * np.pi / np.maximum(1.0, zeta) / fineness
    held = np.zeros(lanes, int)  # 1 + index of the stop on which the body rests, or 0
    for i, (sign, gap, _) in enumerate(stops):
        there = (sign * Y >= gap) & (V == 0) & (sign * np.cos(section) > gap)
        held[there] = 1 + i
    whole = 2 * np.pi / zeta
    begin, rows = np.stack([Y, V]), []
    for _ in range(cycles):
        t = np.zeros(lanes)
        low, high = Y.copy(), Y.copy()
        hits, comes = np.zeros(lanes, int), np.zeros(lanes, int)
        while True:
            on = np.flatnonzero(t < whole)
            if not on.size:
                break
            for i, (sign, gap, _) in enumerate(stops):
                mine = on[held[on] == 1 + i]
                until = _release(sign, gap[mine], section[mine] + zeta[mine] * t[mine])
                later = t[mine] + until / zeta[mine]
                # Slightly late, so that rounding cannot make the force positive again.
                t[mine] = np.minimum(later + LATE, whole[mine])
                held[mine[later <= whole[mine]]] = 0
            on = on[(held[on] == 0) & (t[on] < whole[on])]
            _look(
                on, zeta, xi, section, stops, look, whole, (t, Y, V, held, low, high, hits, comes)
            )
        rows.append((np.stack([Y, V]), low, high, hits, comes))
    return _truth(begin, rows)


def _truth(begin, rows):
    """Return the results from the first state and the five numbers of each cycle."""
    states, *others = zip(*rows, strict=True)
    return Truth(*map(np.array, ((begin, *states), *others)))


def _look(on, zeta, xi, section, stops, look, whole, arrays):
    """Advance free lanes `on` by one interval or to their next contact, in place."""
    t, Y, V, held, low, high, hits, comes = arrays
    if not on.size:
        return
    phase = section[on] + zeta[on] * t[on]
    flight = _Flight(zeta[on], xi[on], phase, Y[on], V[on])
    left = whole[on] - t[on]
    length = np.where(left <= look[on] * (1 + 1e-9), left, look[on])
    times, heights = flight.pieces(length)
    first = np.full(on.size, len(times))
    which = np.full(on.size, -1)
    for i, (sign, gap, _) in enumerate(stops):
        over = (sign * heights - gap[on] > ROUNDING) & (
            sign * np.diff(heights, axis=0, prepend=0) > 0
        )
        over[0] = False
        place = np.where(over.any(axis=0), over.argmax(axis=0), len(times))
        which, first = np.where(place < first, i, which), np.minimum(first, place)
    end = length.copy()
    for i, (sign, gap, _) in enumerate(stops):
        mine = np.flatnonzero(which == i)
        rows = first[mine]
        end[mine] = flight.root(
            0, times[rows - 1, mine], times[rows, mine], mine, sign * gap[on[mine]]
        )
    passed = np.arange(len(times))[:, None] < first
    low[on] = np.minimum(low[on], np.where(passed, heights, np.inf).min(axis=0))
    high[on] = np.maximum(high[on], np.where(passed, heights, -np.inf).max(axis=0))
    terms = flight.terms(end)
    Y[on], V[on] = flight.derivative(0, terms), flight.derivative(1, terms)
    t[on] = np.where(end == left, whole[on], t[on] + end)
    for i, (sign, gap, k) in enumerate(stops):
        mine = on[which == i]
        speed = np.maximum(sign * V[mine], 0.0)
        force = sign * np.cos(section[mine] + zeta[mine] * t[mine]) - gap[mine]
        done, wait = chatter(k[mine], speed, force)
        Y[mine] = sign * gap[mine]
        V[mine] = np.where(done, 0.0, -sign * k[mine] * speed)
        held[mine[done]] = 1 + i
        t[mine] += np.where(done, np.minimum(wait, whole[mine] - t[mine]), 0.0)
        hits[mine] += 1
        comes[mine] += done
        low[mine], high[mine] = np.minimum(low[mine], Y[mine]), np.maximum(high[mine], Y[mine])


def chatter(k, speed, force):
    """Return whether impacts at this speed and contact force end in rest, and after which time.

    Flights take 2kⁿV/a each: Σ = 2kV/(a(1 - k)).
    """
    ends = (force > 0) & (k < 1)
    safe = np.where(ends, force * (1 - k), 1.0)
    wait = np.where(ends, 2 * k * speed / safe, np.inf)
    height = (k * speed) ** 2 / (2 * np.where(ends, force, 1.0))
    return ends & ((wait <= BRIEF) | ((height <= FLAT) & (wait <= LONG))), wait


def _release(sign, gap, phase):
    """Return the crank angle until sign·cos φ falls through `gap`, or infinity."""
    falls = np.arccos(np.clip(gap, -1, 1)) + (0 if sign > 0 else np.pi)
    return np.where(gap > -1, np.mod(falls - phase, 2 * np.pi), np.inf)


def integrated(drive, xi, stops, start, cycles, *, look=0.05, **options):
    """Compute one machine for `cycles` drive cycles with SciPy in time τ.

    **Arguments:** `drive`, a number ζ or a motor's dict of `tau0`, `kappa`, `eps`, `mu` and `w0`
    (default 1); ξ; a tuple of (sign, gap, k); the start (Y, V) or (Y, V, W) on the section φ = 0;
    `look`, the longest step; options of `solve_ivp` (default: DOP853 at 1e-12).

    **Returns:** a `Truth`.
    """
    ideal = not isinstance(drive, dict)
    motor = {"w0": 1.0, **(dict.fromkeys(("tau0", "kappa", "eps", "mu"), 0.0) if ideal else drive)}
    state = np.array([*start, *((drive,) if ideal else ()), 0.0])
    held = 0
    for i, (sign, gap, _) in enumerate(stops):
        if sign * start[0] >= gap and start[1] == 0 and sign > gap:
            held = 1 + i
    begin, rows = state[: len(start)], []
    leaving = [sign * state[0] >= gap and sign * state[1] <= 0 for sign, gap, _ in stops]
    for _ in range(cycles):
        low = high = state[0]
        hits = comes = 0
        while True:
            leg = _leg(motor, xi, stops, state, held, leaving, max_step=look, **options)
            state, seen, met = leg
            low, high = min(low, *seen), max(high, *seen)
            if met == "section":
                break
            kind, i = met
            sign, gap, k = stops[i]
            if kind == "release":
                held, leaving[i] = 0, True
            elif kind == "turn":
                leaving[i] = False
            else:
                hits += 1
                leaving = [j == i for j in range(len(stops))]
                speed, force = max(sign * state[1], 0.0), sign * np.cos(state[3]) - gap
                done, wait = chatter(k, speed, force)
                state[:2] = sign * gap, 0.0 if done else -sign * k * speed
                if done:
                    comes, held = comes + 1, 1 + i
                    state[2:] += wait * np.array(_rates(motor, xi, state)[2:])
        state[3] = 0.0
        rows.append((state[: len(start)].copy(), low, high, hits, comes))
    return _truth(begin, rows)


def _rates(motor, xi, x):
    """Return d/dτ of Y, V, W and the crank angle for the cosine crank."""
    Y, V, W, phi = x
    slope, pull = -np.sin(phi), np.cos(phi) - Y
    torque = motor["tau0"] * (motor["kappa"] - W / motor["w0"]) - motor["eps"] * slope * pull
    torque += motor["mu"] * slope * np.cos(phi) * W * W
    return [V, pull - 2 * xi * V, torque / (1 + motor["mu"] * slope**2), W]


def _leg(motor, xi, stops, state, held, leaving, **options):
    """Integrate to the next event; return the state, Y at the extrema and the end, and the event.

    After an impact or a release, the body must turn towards the stop before a contact is searched,
    so that no event function is zero at its start.
    """

    def rates(t, x):
        flow = _rates(motor, xi, x)
        return [0.0, 0.0, *flow[2:]] if held else flow

    def section(t, x):
        return x[3] - 2 * np.pi

    def stationary(t, x):
        return x[1]

    events, names = [section], ["section"]
    section.terminal, section.direction = True, 1
    for i, (sign, gap, _) in enumerate(stops):
        if held and held != 1 + i:
            continue

        def event(t, x, sign=sign, gap=gap, leaves=leaving[i]):
            if held:
                return gap - sign * np.cos(x[3])
            return sign * x[1] if leaves else sign * x[0] - gap

        event.terminal, event.direction = True, 1
        events.append(event)
        names.append(("release" if held else "turn" if leaving[i] else "contact", i))
    # Extrema of the motion do not end the integration.
    events.append(stationary)
    options = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13, **options}
    run = solve_ivp(rates, (0, 1e4), state, events=events, **options)
    which = next(i for i, times in enumerate(run.t_events[:-1]) if len(times))
    seen = [run.y[0, -1], *(x[0] for x in run.y_events[-1])]
    after = run.y[:, -1].copy()
    if names[which][0] == "release":
        # Slightly late, so that rounding cannot make the force positive again.
        after += LATE * np.array(rates(0.0, after))
    return after, seen, names[which]
