"""Random structures with stops, and their motions by matrix exponentials."""

import numpy as np
import vi_jax as vi

from linear_truth import Contact, LinearTruth

KINDS = ("undamped", "proportional", "general", "defective", "rigid")


def matrices(random, n, kind):
    """Return random M, C, K with natural frequencies between 0.7 and 3."""
    root = random.normal(size=(n, n))
    mass = root @ root.T / n + 0.5 * np.eye(n)
    shapes = np.linalg.cholesky(mass) @ np.linalg.qr(random.normal(size=(n, n)))[0]
    omega = np.sort(random.uniform(0.7, 3.0, n))
    if kind == "rigid":
        omega[0] = 0.0
    stiffness = shapes * omega**2 @ shapes.T
    damping = 0.03 * mass + 0.02 * stiffness
    if kind == "undamped":
        damping = 0 * mass
    elif kind == "general":
        root = 0.3 * random.normal(size=(n, n))
        damping = damping + root @ root.T
    elif kind == "defective":  # critically damped modes: double roots with one eigenvector
        damping = shapes * 2 * omega @ shapes.T
    return tuple(0.5 * (x + x.T) for x in (mass, damping, stiffness))


def machine_and_truth(seed, n, kind, restitutions=(0.7, 0.8, 0.6), pressed=0.0):
    random = np.random.default_rng(seed)
    parts = matrices(random, n, kind)
    first, second = random.normal(size=(2, n)) * np.sqrt(3 / n)
    loads = [scale * random.normal(size=n) for scale in (pressed, 0.7, 0.7)]
    frequency = random.uniform(0.6, 1.8)
    gaps = random.uniform(0.4, 0.9, 3)
    contacts = [
        Contact(row, gap, k, sign)
        for row, gap, k, sign in zip(
            (first, first, second), gaps, restitutions, (1, -1, 1), strict=True
        )
    ]
    stops = tuple(
        vi.RigidStop(c.gap, c.restitution, "right" if c.sign > 0 else "left", at=c.row)
        for c in contacts
    )
    mass, damping, stiffness = parts
    machine = vi.machines.Structure(
        mass=mass, damping=damping, stiffness=stiffness, contacts=stops, static_force=loads[0],
        force=loads[1], sine_force=loads[2], frequency=frequency,
    )  # fmt: skip
    start = 0.02 * random.normal(size=n), 0.2 * random.normal(size=n)
    return machine, LinearTruth(parts, loads, frequency, contacts), start
