"""The woodpecker toy by SciPy, event by event, its laws written out again: the truth of tests.

At most one contact is closed at a time, as in its cycle; anything else is refused.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

M, S, JM, JS, LM, LG, LS = 3e-4, 4.5e-3, 5e-9, 7e-7, 0.010, 0.015, 0.0201
HM, HS, RM, RO, C, G = 0.0058, 0.02, 0.0031, 0.0025, 0.0056, 9.81
SECTION = -0.2788
JAMMED = -(RM - RO) / HM

MASS = np.array(
    [
        [S + M, S * LM, S * LG],
        [S * LM, JM + S * LM**2, S * LM * LG],
        [S * LG, S * LM * LG, JS + S * LG**2],
    ]
)
WEIGHT = G * np.array([S + M, S * LM, S * LG])
# Of each contact: its gap is what stands first plus this row times q, it slips with the next row,
# and leaves with so much of the speed of approach.
GAPS = np.array([RM - RO, RM - RO, LM + LG - LS - RO])
NORMALS = np.array([[0, HM, 0], [0, -HM, 0], [0, 0, -HS]])
SLIPS = np.array([[1, RM, 0], [1, RM, 0], [1, LM, LG - LS]])
RESTITUTION = np.array([0.0, 0.0, 0.5])


class Cycle(NamedTuple):
    """From a state to the next section."""

    state: np.ndarray
    """q and its rates there, the height since the start."""
    duration: float
    events: list[tuple[str, int, float]]
    impact_loss: float
    rubbed: float
    """The work of friction between impacts."""


def energy(x: np.ndarray) -> float:
    """Of motion, spring and height."""
    return float(0.5 * x[3:] @ MASS @ x[3:] + 0.5 * C * (x[1] - x[2]) ** 2 + WEIGHT @ x[:3])


def forces(x: Any, contact: int | None, slip: int, mu: float) -> tuple[Any, float, float]:
    """Accelerations, and the forces on a closed contact and along it."""
    bend = C * (x[1] - x[2])
    free = np.linalg.solve(MASS, -WEIGHT + np.array([0, -bend, bend]))
    if contact is None:
        return free, 0.0, 0.0
    n, t = NORMALS[contact], SLIPS[contact]
    if slip:
        pushed = np.linalg.solve(MASS, n - mu * slip * t)
        normal = -(n @ free) / (n @ pushed)
        return free + pushed * normal, normal, -mu * slip * normal
    both = np.stack([n, t])
    pushed = np.linalg.solve(MASS, both.T)
    normal, along = np.linalg.solve(both @ pushed, -both @ free)
    return free + pushed @ [normal, along], normal, along


def struck(v: np.ndarray, contact: int, mu: float) -> tuple[np.ndarray, int]:
    """Rates after an impact, and the way that the contact slips then."""
    n, t = NORMALS[contact], SLIPS[contact]
    wanted = -(1 + RESTITUTION[contact]) * (n @ v)
    both = np.stack([n, t])
    pushed = np.linalg.solve(MASS, both.T)
    normal, along = np.linalg.solve(both @ pushed, [wanted, -(t @ v)])
    if abs(along) <= mu * normal:
        return v + pushed @ [normal, along], 0
    for slip in (1, -1):
        pushed = np.linalg.solve(MASS, n - mu * slip * t)
        after = v + pushed * wanted / (n @ pushed)
        if slip * (t @ after) > 0:
            return after, slip
    raise AssertionError("neither sticks nor slips")


def settled(x: Any, contact: int, slip: int, mu: float) -> tuple[int | None, int]:
    """Whether a contact that has just been closed stays so, and how it slips."""
    if slip == 0:
        _, normal, along = forces(x, contact, 0, mu)
        if abs(along) > mu * normal:
            slip = -int(np.sign(along))
    normal = forces(x, contact, slip, mu)[1]
    return (contact, slip) if normal > 0 else (None, 0)


def cycle(start: Any, mu: float) -> Cycle:
    """From a start on the lower edge, which slips down, to where φS falls through the section."""
    x, contact, slip = np.append(np.asarray(start, float), 0.0), 0, -1
    t, events, loss, passed = 0.0, [], 0.0, False
    for _ in range(60):
        mode = contact, slip

        def rate(t, x, mode=mode):
            acceleration, _, along = forces(x, *mode, mu)
            speed = 0.0 if mode[0] is None else along * (SLIPS[mode[0]] @ x[3:6])
            return [*x[3:6], *acceleration, -speed]

        tests: list[tuple[str, int, Any]] = [
            ("impact", i, lambda t, x, i=i: GAPS[i] + NORMALS[i] @ x[:3])
            for i in range(3) if i != contact
        ]  # fmt: skip
        if contact is not None:
            own = SLIPS[contact]
            tests.append(("release", contact, lambda t, x, m=mode: forces(x, *m, mu)[1]))
            if slip:
                tests.append(("mode", contact, lambda t, x, k=slip, w=own: k * (w @ x[3:6])))
            else:
                tests.append(("mode", contact, lambda t, x, m=mode: _held(x, m, mu)))
        tests.append(("section", -1, lambda t, x: x[2] - SECTION))
        for _, _, test in tests:
            test.terminal, test.direction = True, -1
        if not passed:
            tests[-1][2].terminal = False  # it begins there
        found = solve_ivp(
            rate, (t, t + 1), x, method="DOP853", rtol=1e-13, atol=1e-16, max_step=2e-3,
            events=[test for _, _, test in tests],
        )  # fmt: skip
        passed = True
        met = [
            i for i, times in enumerate(found.t_events) if times.size and times[-1] == found.t[-1]
        ]
        kind, number, _ = tests[met[0]]
        t, x = found.t[-1], found.y[:, -1].copy()
        if kind == "section":
            return Cycle(x[:6], t, events, loss, float(x[6]))
        events.append((kind, number, t))
        if kind == "impact":
            assert contact is None, "two contacts at once"
            before = energy(x[:6])
            x[3:6], slip = struck(x[3:6], number, mu)
            loss += before - energy(x[:6])
            contact, slip = (None, 0) if RESTITUTION[number] else settled(x[:6], number, slip, mu)
        elif kind == "release":
            contact, slip = None, 0
        else:
            assert contact is not None
            if slip:
                contact, slip = settled(x[:6], contact, 0, mu)
            else:
                slip = -int(np.sign(forces(x, contact, 0, mu)[2]))
    raise AssertionError("no section")


def _held(x: Any, mode: tuple[int, int], mu: float) -> float:
    """What friction could hold beyond what it does."""
    _, normal, along = forces(x, *mode, mu)
    return mu * normal - abs(along)
