"""Send Ctrl-C to each way of calling a kernel, and print the seconds until it ends."""

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

# A shell makes its background processes ignore Ctrl-C.
signal.signal(signal.SIGINT, signal.default_int_handler)

SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.01)
MOTOR = vi.Parameters().scene(drive="motor")
STARTS = jnp.linspace(-0.1, 0.1, 64)
LONG = 10**9


def last(V, settle):
    return vi.simulate(SCENE, SCENE.start(V=V), 1, settle=settle).last.Y


lanes = jax.vmap(last, (0, None))
quick = jax.jit(last)
slope = jax.jit(jax.grad(last))


def swept(settle):
    values = jnp.linspace(0.5, 1.9, 3 if settle == 1 else 30_000)
    return vi.sweep(MOTOR, "drive.control", values, settle=20, cycles=2).y_min


WAYS = {
    "simulate": lambda settle: vi.simulate(SCENE, SCENE.start(), 1, settle=settle).last.Y,
    "jit": lambda settle: quick(0.1, settle), "vmap": lambda settle: lanes(STARTS, settle),
    "grad": lambda settle: slope(0.1, settle), "sweep": swept,
}  # fmt: skip


def time_to_end(way, delay):
    np.asarray(way(1))  # compile
    at = []

    def strike():
        time.sleep(delay)
        at.append(time.perf_counter())
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=strike, daemon=True).start()
    try:
        while True:
            try:
                np.asarray(way(LONG))
            except Exception as error:  # as a user's loop may do
                print(f"swallowed {error!r}", file=sys.stderr)
    except KeyboardInterrupt:
        pass
    np.asarray(jnp.sin(jnp.arange(3.0)))  # wait for running programs
    return time.perf_counter() - at[0]


for name in WAYS:
    print(name, *(time_to_end(WAYS[name], delay) for delay in (0.3, 0.55)))
