"""Verbs left at Ctrl-C: prints how long each took to end (seconds), and how much it had."""

import os
import signal
import sys
import threading
import time

import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import numpy as np
import vi_jax as vi

# A shell starts what runs in the background without it.
signal.signal(signal.SIGINT, signal.default_int_handler)

MOTOR = vi.Parameters().scene(drive="motor")
IDEAL = vi.Scene.ideal(frequency_ratio=1.4, restitution=0.8, gap=2.0, damping_ratio=0.05)


def sweep(values=20_000):
    return vi.sweep(MOTOR, "drive.control", jnp.linspace(0.5, 1.9, values), settle=20)


def basins(settle):
    region = {"start.Y": (-6.0, 2.0), "start.V": (-6.0, 6.0)}
    return vi.basins(IDEAL, region, resolution=(128, 64), settle=settle, lanes=256, progress=False)


def branch(max_points=10**6):
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.0)
    orbit = vi.find_orbit(scene, scene.start(Y=1.6, V=-1.9), cycles=2)
    return vi.continue_orbit(
        orbit, parameter="drive.frequency_ratio", bounds=(0.5, 1.9), max_step=1e-4,
        max_points=max_points,
    )  # fmt: skip


def share(error):
    """What there is of what was asked for."""
    partial = error.partial
    if isinstance(partial, vi.Sweep):
        done = bool(partial.successful.all()) and partial.y_min.size == partial.values.size
        return partial.values.size if done else -1
    if isinstance(partial, vi.Branch):
        assert "interrupted" in partial.ends
        return len(partial.parameter) if np.isfinite(partial.y_min).all() else -1
    done = np.asarray(error.data["result"]) >= 0
    return int(done.sum()) if done.sum() < done.size else -1


# What is interrupted, after how long, and the same programs with less to do, which compiles them.
VERBS = {
    "sweep": (sweep, 8.0, lambda: sweep(400)),
    # Many short blocks, and then one long one.
    "basins": (lambda: basins(4_000), 8.0, lambda: basins(1)),
    "long basins": (lambda: basins(10**8), 1.0, lambda: basins(1)),
    "branch": (branch, 3.0, lambda: branch(20)),
}

for name in sys.argv[1:] or VERBS:
    verb, delay, less = VERBS[name]
    less()
    at = []

    def strike(delay=delay, at=at):
        time.sleep(delay)
        at.append(time.perf_counter())
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=strike, daemon=True).start()
    try:
        try:
            verb()
            print(name, "was not interrupted")
        except Exception as error:
            print(name, repr(error))
    except vi.Interrupted as error:
        took = time.perf_counter() - at[0]
        np.asarray(jnp.sin(jnp.arange(3.0)))  # waits for what runs still
        print(name, took, time.perf_counter() - at[0], share(error), sep=", ")
