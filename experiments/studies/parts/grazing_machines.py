"""Random machines of `grazing_forecast.py`, and motions of one cycle that graze."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi

REMEMBERS = 0.95
"""Motions whose largest multiplier is above this are not taken: simulation settles too slowly."""
SETTLE = 400


def changed(machine: Any, name: str, value: Any) -> Any:
    """The same machine with another number in place of that name."""

    return eqx.tree_at(lambda machine: number(machine, name), machine, value)


def number(machine: Any, name: str) -> Any:
    """A number of a machine by its name, as "stops.0.gap"."""
    for part in name.split("."):
        machine = machine[int(part)] if part.isdigit() else getattr(machine, part)
    return machine


class TwoBodies(vi.AbstractMachine):
    """Two bodies on cubic springs, the first shaken; one of them meets a stop. By the phase ωt."""

    frequency: Any
    damping: Any
    cubic: Any
    coupling: Any
    mass: Any
    """Of the second over that of the first."""
    gap: Any
    restitution: Any
    second: bool = eqx.field(static=True)
    """Whether it is the second that meets the stop."""

    @property
    def contacts(self):  # pyright: ignore
        return (vi.RigidStop(self.gap, self.restitution),)

    @property
    def cycle(self):
        return 2 * np.pi

    def position(self, x):  # pyright: ignore
        return x[2 * self.second]

    def velocity(self, x):  # pyright: ignore
        return x[2 * self.second + 1]

    def placed(self, x, Y, V):  # pyright: ignore
        i = 2 * self.second
        return (*x[:i], Y, V, *x[i + 2 :])

    def field(self, s, x):
        y, u, z, v = x
        pull = self.coupling * (y - z) + 0.2 * self.damping * (u - v)
        first = jnp.cos(s) - y - self.cubic * y**3 - self.damping * u - pull
        second = (pull - self.damping * v - 0.5 * z) / self.mass
        return tuple(rate / self.frequency for rate in (u, first, v, second))

    def start(self):
        return tuple(map(jnp.asarray, (0.0, 0.0, 0.0, 0.0)))


class Compliant(vi.AbstractMachine):
    """A shaken body with a soft stop, by the phase ωt."""

    frequency: Any
    damping: Any
    cubic: Any
    stop: vi.SoftStop

    @property
    def contacts(self):
        return self.stop

    def pace(self, s, state):
        return 1 / self.frequency

    @property
    def cycle(self):
        return 2 * np.pi

    def field(self, s, x):
        push = jnp.cos(s) - x.Y - self.cubic * x.Y**3 - self.damping * x.V
        return vi.OscillatorState(x.V / self.frequency, push / self.frequency)

    def start(self):
        return vi.OscillatorState(jnp.asarray(0.0), jnp.asarray(0.0))


def is_soft(machine: Any) -> bool:
    """Whether its stop is a soft one."""
    return isinstance(machine, Compliant)


class Drawn(NamedTuple):
    """A machine whose motion from rest is followed in one of its numbers."""

    kind: str
    machine: Any
    parameter: str
    bounds: tuple[float, float]


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def scene(rng: np.random.Generator) -> Drawn:
    """The paper's machine with an ideal drive."""
    zeta, xi = rng.uniform(0.25, 2.5), _log(rng, 0.05, 2.5)
    reach = 1 / abs(1 - zeta**2 + 2j * xi * zeta)
    gap = reach * rng.choice([rng.uniform(0.1, 0.95), 1.2])
    machine = vi.Scene.ideal(
        frequency_ratio=zeta, restitution=rng.uniform(0.3, 0.95), gap=gap, damping_ratio=xi
    )
    if rng.random() < 0.5:
        return Drawn("scene", machine, "stops.0.gap", (0.02 * reach, 1.4 * reach))
    return Drawn("scene", machine, "drive.frequency_ratio", (0.4 * zeta, 2.5 * zeta))


@jax.jit
@jax.vmap
def _turns_back(machine: Any) -> tuple[Any, Any, Any]:
    """How nearly the motion repeats after a cycle, how near it comes to a wall that it does not
    hit, and whether it was followed."""
    run: Any = vi.simulate(machine, machine.start(), 1, settle=SETTLE, impact_log=8)
    ends = jnp.stack(jax.tree.leaves(run.sections))
    return jnp.abs(ends[:, 1] - ends[:, 0]).max(), run.clearance[0], run.successful


def pairs(rng: np.random.Generator) -> list[Drawn]:
    """Balls in boxes that are bodies on springs themselves. In few of them the ball turns back just
    before a wall: of many these are taken."""
    many = 4096
    numbers: dict[str, Any] = {
        "half_gap": rng.uniform(0.05, 3.0, many), "restitution": rng.uniform(0.2, 0.9, many),
        "mass_ratio": rng.uniform(0.05, 0.5, many), "damping_ratio": rng.uniform(0.05, 0.5, many),
        "frequency": rng.uniform(0.3, 2.0, many), "force": rng.uniform(0.5, 2.0, many),
    }  # fmt: skip
    repeats, room, good = map(np.asarray, _turns_back(vi.machines.ImpactPair(**numbers)))
    taken = np.flatnonzero(good & (repeats < 1e-9) & (room < 0.05 * numbers["half_gap"]))
    found = []
    for i in taken:
        own: dict[str, Any] = {name: float(x[i]) for name, x in numbers.items()}
        machine = vi.machines.ImpactPair(**own)
        name = ("half_gap", "restitution", "force")[rng.integers(3)]
        value = numbers[name][i]
        found.append(Drawn("pair", machine, name, _around(name, value)))
    return found


def _around(name: str, value: float) -> tuple[float, float]:
    return 0.7 * value, min(1.3 * value, 0.98) if name == "restitution" else 1.3 * value


def two_bodies(rng: np.random.Generator) -> Drawn:
    """Two degrees of freedom with cubic springs and a stop."""
    machine = TwoBodies(  # pyright: ignore
        frequency=jnp.asarray(rng.uniform(0.3, 2.5)), damping=jnp.asarray(_log(rng, 0.1, 3.0)),
        cubic=jnp.asarray(rng.uniform(0.0, 0.5)), coupling=jnp.asarray(rng.uniform(0.2, 2.0)),
        mass=jnp.asarray(rng.uniform(0.3, 2.0)), gap=jnp.asarray(100.0),
        restitution=jnp.asarray(rng.uniform(0.3, 0.95)), second=bool(rng.integers(2)),
    )  # fmt: skip
    return _within_reach(rng, "two bodies", machine, "gap")


def relaxed(rng: np.random.Generator) -> Drawn:
    """A spring with a dashpot that is relaxed when it is touched."""
    return _compliant(rng, "soft", {"restitution": rng.uniform(0.4, 1.0)})


def prestressed(rng: np.random.Generator) -> Drawn:
    """A spring that is held under tension by its seat."""
    return _compliant(rng, "prestressed", {"prestress": _log(rng, 0.1, 5.0)})


def _compliant(rng: np.random.Generator, kind: str, options: dict) -> Drawn:
    machine = Compliant(  # pyright: ignore
        jnp.asarray(rng.uniform(0.3, 2.5)), jnp.asarray(_log(rng, 0.1, 4.0)),
        jnp.asarray(rng.uniform(0.0, 0.5)), vi.SoftStop(100.0, _log(rng, 5.0, 100.0), **options),
    )  # fmt: skip
    return _within_reach(rng, kind, machine, "stop.gap")


def _within_reach(rng: np.random.Generator, kind: str, machine: Any, gap: str) -> Drawn:
    """Its stop just beyond what it reaches without one, or half of the time well within."""
    run: Any = vi.simulate(machine, machine.start(), 3, settle=SETTLE)
    reach = float(run.y_max[-1])
    share = 1.15 if kind != "two bodies" or rng.random() < 0.5 else rng.uniform(0.2, 0.9)
    machine = changed(machine, gap, jnp.asarray(share * reach))
    return Drawn(kind, machine, gap, (0.05 * reach, 1.3 * reach))


def grazing_of(drawn: Drawn) -> vi.Point | None:
    """The first grazing at which the motion of one cycle that the machine settles on from rest (or
    where its branch leads) touches a stop and is stable until then; `None` without one."""
    machine = drawn.machine
    run = vi.simulate(machine, machine.start(), 1, settle=SETTLE)
    if not bool(run.successful):
        return None
    orbit = vi.find_orbit(machine, run.last, cycles=1, impact_log=16)
    if (
        orbit.result != vi.ORBIT_RESULTS.successful
        or not bool(orbit.stable)
        or int(orbit.impacts) > 16
    ):
        return None
    branch = vi.continue_orbit(
        orbit, parameter=drawn.parameter, bounds=drawn.bounds, progress=False
    )
    for point in branch.special:
        if point.kind != "grazing" or point.impact is not None or not point.touches:
            continue
        if np.abs(np.asarray(point.orbit.multipliers)).max() < REMEMBERS:
            return point
    return None


KINDS = {
    "scene": (scene, 13), "pair": (pairs, 12), "two bodies": (two_bodies, 13), "soft": (relaxed, 6),
    "prestressed": (prestressed, 6),
}  # fmt: skip
"""How machines of each kind are drawn, and how many of them."""


def machines(draw: Any, count: int, seed: int) -> list[tuple[Drawn, vi.Point]]:
    """So many machines of a kind that graze, each with its grazing."""
    rng, found = np.random.default_rng(seed), []
    while len(found) < count:
        drawn = draw(rng)
        for each in drawn if isinstance(drawn, list) else [drawn]:
            point = grazing_of(each)
            if point is not None:
                found.append((each, point))
            if len(found) == count:
                break
    return found
