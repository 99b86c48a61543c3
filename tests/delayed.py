"""Oscillators with delayed feedback, and delay differential equations by the method of steps:
SciPy, cut at events and at images."""

import heapq
from bisect import bisect_right
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from scipy.integrate import solve_ivp


class Fed(vi.AbstractMachine):
    """A driven oscillator with delayed feedback of its position."""

    omega: float = 0.8
    damping: float = 0.05
    gain: float = 0.3
    delay: float = 4.0

    cycle = property(lambda self: 2 * jnp.pi / self.omega)
    delays = property(lambda self: dict(sensor=self.delay))

    def field(self, t, z, past):
        pull = self.gain * (past.sensor.x - z.x)
        return dict(x=z.u, u=jnp.cos(self.omega * t) - z.x - 2 * self.damping * z.u + pull)

    def start(self):
        return vi.State(x=0.0, u=0.0)


class Struck(Fed):
    """The same that hits a stop; `first` is its position before."""

    gap: float = 0.6
    restitution: float = 0.7
    first: float = 0.0

    before = property(lambda self: vi.State(x=self.first, u=0.0))

    @property
    def contacts(self):
        return vi.RigidStop(self.gap, self.restitution, on=("x", "u"))


class Masses(vi.Mechanical):
    """`Struck` as a machine of masses."""

    gain: float = 0.3
    q = ("x",)
    mass = (1.0,)
    cycle = 2 * np.pi / 0.8
    delays = property(lambda self: dict(sensor=4.0))
    contacts = vi.RigidStop(0.6, 0.7, on="x")

    def force(self, t, q, v, past):
        pull = self.gain * (past.sensor.x - q.x)
        return dict(x=jnp.cos(0.8 * t) - q.x - 0.1 * v.x + pull)


class Turning(vi.AbstractMachine):
    """A tool that cuts the surface which it left one turn ago, and may leave the cut."""

    stiffness: float = 0.3
    turn: float = 8.0
    feed: float = 1.0
    damping: float = 0.03
    before = vi.State(surface=0.0)
    cycle = property(lambda self: self.turn)
    delays = property(lambda self: dict(turn=self.turn))
    events = vi.Switch(lambda m, t, z, past: m.feed + past.turn.surface - z.x)

    def recorded(self, t, z, past, cuts):
        return dict(surface=jnp.where(cuts > 0, z.x, past.turn.surface + self.feed))

    def field(self, t, z, past, cuts):
        chip = self.feed + past.turn.surface - z.x
        force = jnp.where(cuts > 0, self.stiffness * chip, 0.0)
        return dict(x=z.u, u=force - z.x - 2 * self.damping * z.u)

    def start(self):
        return vi.State(x=0.0, u=0.0)


def by_steps(
    rate: Callable[..., Any], start: Sequence[float], before: Callable[[float], Any],
    delays: Sequence[float], end: float, *, guard: Callable[..., float] | None = None,
    jump: Callable[..., Any] | None = None, levels: int = 7, mode: Any = None,
    quiet: Callable[..., float] = lambda y: 0.02,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return the state at `end`, and the instants of events. `rate(t, y, pasts)` and
    `guard(t, y, pasts)` receive the state one delay ago, for each delay; `jump(y, pasts)` is the
    state after an event, where the guard rises through zero. With a `mode`, at first this one, they
    receive it last, `jump(t, y, pasts, mode)` the time, too, and it returns state and mode. No
    event follows another within the time `quiet(y)`."""
    begins, pieces, events = [0.0], [], []

    def past(t: float, side: float) -> list[Any]:
        found = []
        for delay in delays:
            place = t - delay
            number = bisect_right(begins, place + side) - 1
            old = number < 0 or not pieces
            found.append(before(place) if old else pieces[min(number, len(pieces) - 1)](place))
        return found

    waiting, modes = [(end, levels)], () if mode is None else (mode,)

    def wait_for_images(t: float, level: int) -> None:
        if level < levels:
            for delay in delays:
                heapq.heappush(waiting, (t + delay, level + 1))

    wait_for_images(0.0, 0)
    t, y, armed = 0.0, np.asarray(start, float), guard is None
    while t < end - 1e-12:
        while waiting[0][0] <= t + 1e-11:
            wait_for_images(*heapq.heappop(waiting))
        stop, begin = min(waiting[0][0], t + min(delays)), t
        armed = armed or (guard is not None and guard(t, y, past(t, 1e-11), *modes) < -1e-12)
        stop = stop if armed else min(stop, t + quiet(y))

        def side(s: float, begin: float = begin, stop: float = stop) -> float:
            return 1e-11 if s < 0.5 * (begin + stop) else -1e-11

        meets = None
        if guard is not None and armed:
            meets = lambda s, y, side=side, m=modes: guard(s, y, past(s, side(s)), *m)
            meets.terminal, meets.direction = True, 1
        found = solve_ivp(
            lambda s, y, side=side, m=modes: rate(s, y, past(s, side(s)), *m), (t, stop), y,
            method="DOP853", rtol=1e-12, atol=1e-14, max_step=0.1, events=meets, dense_output=True,
        )  # fmt: skip
        begins[len(pieces) :] = [t]
        pieces.append(found.sol)
        t, y = float(found.t[-1]), found.y[:, -1]
        if found.status == 1:
            events.append(t)
            armed = False  # until the guard has been negative
            if modes:
                y, *modes = jump(t, y, past(t, -1e-11), *modes)
            else:
                y = jump(y, past(t, -1e-11))
            y = np.asarray(y)
            wait_for_images(t, 0)
    return y, np.asarray(events)


def struck_by_steps(m: dict[str, float], cycles: int) -> tuple[np.ndarray, list[tuple[float, int]]]:
    """Return the last state of `Fed` with dry friction `level`, from the origin, and its events:
    the instant, and the mode that ends there. Modes are the direction of sliding, 0 in which
    friction holds the body, and 2 in which it rests on the stop."""
    level, gap, events = m["level"], m["gap"], []

    def force(t, y, past):
        pull = m["gain"] * (past[0][0] - y[0])
        return np.cos(m["omega"] * t) - y[0] - 0.1 * y[1] + pull

    def rate(t, y, past, mode):
        return [0, 0] if mode in (0, 2) else [y[1], force(t, y, past) - level * mode]

    def guard(t, y, past, mode):
        if mode in (0, 2):
            pulls = force(t, y, past)
            return (-pulls if mode else abs(pulls)) - level
        return max(y[0] - gap, -mode * y[1]) if level or mode > 0 else y[0] - gap

    def jump(t, y, past, mode):
        events.append((t, mode))
        pulls, x = force(t, y, past), y[0]
        if mode == 2:
            return [x, 0.0], -1
        if not level or (x > gap - 1e-9 and y[1] > 1e-12):
            speed = m["restitution"] * y[1]
            if speed > 3e-5:  # the rest of a chatter hardly moves the body
                return [gap, -speed], -1
            return [gap, 0.0], 2 if pulls > 0 else -1
        return [x, 0.0], 0 if mode and abs(pulls) <= level else int(np.sign(pulls))

    end, _ = by_steps(
        rate, [0.0, 0.0], lambda t: [0.0, 0.0], [m["delay"]], cycles * 2 * np.pi / m["omega"],
        guard=guard, jump=jump, mode=1 if level else -1,
        quiet=lambda y: min(0.02, 0.2 * abs(y[1]) or 0.02),
    )  # fmt: skip
    return end, events
