"""The motors of `motor_frequency_response.py`: their sweeps, and the branches beside them."""

import equinox as eqx
import jax
import numpy as np
import vi_jax as vi
from tools.study import QUICK, say
from tools.timing import Clock

Key = tuple[float, float]
"""A motor's stall torque T0 in N·m, and the gap in m."""

K, NEAR, FAR = 0.5, 0.08, 0.8  # restitution; gaps in metres, 2a and 20a: the free motion needs 11a
HIGHEST: dict[Key, float] = {
    (100.0, NEAR): 1.9, (10.0, NEAR): 1.9, (2.0, NEAR): 1.9,
    (0.2, NEAR): 2.6, (0.1, NEAR): 3.6, (0.05, NEAR): 5.6,
    (2.0, FAR): 1.9, (0.5, FAR): 3.0,
}  # fmt: skip
"""The largest κ of the sweeps, beyond each jump."""
if QUICK:
    HIGHEST = {key: HIGHEST[key] for key in ((10.0, NEAR), (0.2, NEAR), (2.0, FAR))}
VALUES, SETTLE = (41, 300) if QUICK else (181, 400)


def machine(torque: float, gap: float, kappa: float) -> vi.Scene:
    """Table 1's machine with k = 0.5."""
    return vi.Parameters(torque=torque, control=kappa, restitution=K, gap=gap).scene(drive="motor")


MACHINE = machine(1.0, NEAR, 1.0)
assert isinstance(MACHINE.drive, vi.Motor)
PER_NM = float(MACHINE.drive.strength)
"""The dimensionless torque τ0 of 1 N·m."""
XI, LOAD = float(MACHINE.damping_ratio), float(MACHINE.drive.coupling)


def one_sweep(torque, gap, kappas):
    """24 steps a cycle instead of the default 12: the strongest motor pulls its shaft back at the
    rate τ0/κ per radian, 13 at T0 = 100 and κ = 0.5, and an explicit solver with 12 diverges there.
    """
    swept = eqx.tree_at(
        lambda s: (s.drive.strength, s.drive.control, s.stops[0].gap),
        MACHINE,
        (PER_NM * torque, kappas[0], gap / 0.04),
    )
    return vi.sweep(
        swept, "drive.control", kappas, settle=SETTLE, cycles=32,
        method=vi.FixedStep(steps_per_cycle=24),
    )  # fmt: skip


# The strong motors close down once more, in steps sixty times as fine below κ = 1.235, where their
# free motion comes near the stop.
COARSE = VALUES // 3
FINE = np.concatenate([np.linspace(1.9, 1.24, COARSE), np.linspace(1.235, 1.217, VALUES - COARSE)])
FINE_STEP = (1.235 - 1.217) / (VALUES - COARSE - 1)


def sweeps() -> tuple[dict[Key, vi.Sweep], dict[Key, vi.Sweep], dict[float, vi.Sweep]]:
    """All motors run up and closed down, and strong ones closed down in fine steps, by T0."""
    grid = np.stack([np.linspace(0.5, high, VALUES) for high in HIGHEST.values()])
    torques, gaps = (np.tile(a, 2) for a in np.array(list(HIGHEST)).T)
    both_ways = np.concatenate([grid, grid[:, ::-1]])
    with Clock() as clock:
        program = vi.jit(jax.vmap(one_sweep)).lower(torques, gaps, both_ways).compile()
    say(f"sweeps compiled in {clock.wall:.1f} s")

    def taken(*arguments: np.ndarray) -> list[vi.Sweep]:
        all_rows = jax.tree.map(np.asarray, program(*arguments))
        return [jax.tree.map(lambda x, i=i: x[i], all_rows) for i in range(len(torques))]

    rows = taken(torques, gaps, both_ways)
    say(f"{grid.size * 2} values of κ swept")
    up, down = (
        dict(zip(HIGHEST, part, strict=True)) for part in (rows[: len(grid)], rows[len(grid) :])
    )
    strong = tuple(torque for torque in (100.0, 10.0) if (torque, NEAR) in HIGHEST)
    # The program has as many rows as before; those that are left over are filled with the same.
    filled = np.resize(strong, len(torques))
    rows = taken(filled, np.full_like(gaps, NEAR), np.tile(FINE, (len(torques), 1)))
    say("fine close-down")
    return up, down, dict(zip(strong, rows, strict=False))


def jump(sweep: vi.Sweep) -> int:
    """The pair of neighbouring values between which the motion changes most."""
    return int(np.nanargmax(np.abs(np.diff(np.asarray(sweep.y_min)))))


def jump_in_kappa(sweep: vi.Sweep) -> tuple[float, float]:
    """The smaller and the larger κ of that pair."""
    i = jump(sweep)
    low, high = sorted(float(x) for x in sweep.values[i : i + 2])
    return low, high


def restless(sweep: vi.Sweep) -> tuple[int, int, int]:
    """Values that failed, that still drift, and that are observed but do not repeat."""
    W = np.asarray(sweep.sections.W)
    early, late = np.split(W, 2, axis=1)
    lost = ~np.isfinite(W).all(axis=1)
    loose = (np.asarray(sweep.period) == vi.REGIMES.unsettled) & ~lost
    drift = np.abs(late.mean(axis=1) - early.mean(axis=1)) > 0.25 * np.ptp(W, axis=1)
    return int(lost.sum()), int((loose & drift).sum()), int((loose & ~drift).sum())


def branches(
    up: dict[Key, vi.Sweep], down: dict[Key, vi.Sweep]
) -> dict[tuple[Key, int], vi.Branch]:
    """The 2π motions in κ, with one impact and with none, by motor and number of impacts.

    They begin at motions that the sweeps met: just before the jump of the run-up, and at the top of
    the close-down.
    """
    found = {}
    for key, impacts in [(key, 1) for key in HIGHEST if key[1] == NEAR] + [
        (key, 0) for key in HIGHEST
    ]:
        sweep = up[key] if impacts else down[key]
        fits = (np.asarray(sweep.period) == 1) & (np.asarray(sweep.impacts) == impacts)
        fits &= np.asarray(sweep.values) > 1
        i = int(np.flatnonzero(fits)[-1 if impacts else 0])
        guess = jax.tree.map(lambda x, i=i: x[i, -1], sweep.sections)
        orbit = vi.find_orbit(machine(*key, float(sweep.values[i])), guess, 1)
        assert bool(orbit.successful), (key, impacts)
        found[key, impacts] = vi.continue_orbit(
            orbit, parameter="drive.control", bounds=(0.5, 6.0), max_step=0.2
        )
        say(f"T0 = {key[0]:g} N·m, gap {key[1]:g} m: {found[key, impacts]}")
    return found


def special(found: dict[tuple[Key, int], vi.Branch], key: Key, way: str) -> vi.SpecialPoint:
    """Where the continued branches say that the sweep up or down must jump."""
    if way == "up":  # the fold at which the motion that it follows turns back
        folds = found[key, 1 if key[1] == NEAR else 0].special
        return max((p for p in folds if p.kind == "fold"), key=lambda p: p.parameter)
    points = found[key, 0].special  # a fold if there is one; or else the touch of the stop
    folds = [p for p in points if p.kind == "fold"]
    return min(folds or points, key=lambda p: p.parameter)
