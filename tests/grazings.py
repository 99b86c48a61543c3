"""Find the grazing at which a branch ends."""

import vi_jax as vi


def grazing_of(machine, name, bounds, start=None):
    orbit = vi.find_orbit(machine, machine.start() if start is None else start, throw=True)
    branch = vi.continue_orbit(orbit, parameter=name, bounds=bounds)
    return next(p for p in branch.special if p.kind == "grazing")
