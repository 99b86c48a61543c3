"""Interrupt basins with Ctrl-C; print the seconds until they end, and the number of starts done."""

import os
import signal
import threading
import time

import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import numpy as np
import vi_jax as vi

# A shell makes its background processes ignore Ctrl-C.
signal.signal(signal.SIGINT, signal.default_int_handler)

SCENE = vi.Scene.ideal(frequency_ratio=1.4, restitution=0.8, gap=2.0, damping_ratio=0.05)


def basins(settle):
    region = {"start.Y": (-6.0, 2.0), "start.V": (-6.0, 6.0)}
    return vi.basins(SCENE, region, resolution=(128, 64), settle=settle, lanes=256, progress=False)


def strike(delay, at):
    time.sleep(delay)
    at.append(time.perf_counter())
    os.kill(os.getpid(), signal.SIGINT)


basins(1)  # compile
for settle, delay in ((20_000, 4.0), (10**8, 1.0)):  # many short blocks, and then one long one
    at = []
    threading.Thread(target=strike, args=(delay, at), daemon=True).start()
    try:
        try:
            basins(settle)
            print("not interrupted")
        except Exception as error:
            print(repr(error))
    except vi.Interrupted as error:
        took = time.perf_counter() - at[0]
        np.asarray(jnp.sin(jnp.arange(3.0)))  # wait for running programs
        done = np.asarray(error.partial["result"]) >= 0
        share = int(done.sum()) if done.sum() < done.size else -1
        print(took, time.perf_counter() - at[0], share)
