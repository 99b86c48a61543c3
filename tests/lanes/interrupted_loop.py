"""Interrupt a loop of simulations many times, and print the numbers of lost and wrong results."""

import gc
import os
import random
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

# Python drops an interrupt within a callback of the garbage collector (JAX 0.10 has one), and
# prints "Exception ignored in".
gc.disable()

INTERRUPTS = 120
SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.01)
STARTS = jnp.linspace(-1.0, 1.0, 64)


@jax.jit
@jax.vmap
def last(V):
    return vi.simulate(SCENE, SCENE.start(V=V), 2, settle=10).last.Y


truth = np.asarray(last(STARTS))
clock = time.perf_counter()
np.asarray(last(STARTS))
took = time.perf_counter() - clock
heard, lost, wrong, errors = [], [], [], []
begun, ended = threading.Event(), threading.Event()


def strike():
    draw = random.Random(0)
    begun.wait()  # no interrupt while Python starts this thread
    for _ in range(INTERRUPTS):
        time.sleep(draw.uniform(0, 2.5 * took))
        before, clock = len(heard), time.perf_counter()
        os.kill(os.getpid(), signal.SIGINT)
        while len(heard) == before and time.perf_counter() - clock < 5:
            time.sleep(1e-4)
        if len(heard) == before:
            lost.append(1)
    ended.set()


def work():
    begun.set()
    while not ended.is_set():
        try:
            found = np.asarray(last(STARTS))
        except Exception as error:
            errors.append(repr(error))
            continue
        if not np.array_equal(found, truth):
            wrong.append(found)


def again(depth):
    """Count interrupts; nested, since one may come while the last is being counted."""
    while not ended.is_set():
        try:
            again(depth - 1) if depth else work()
        except KeyboardInterrupt:
            heard.append(1)


threading.Thread(target=strike, daemon=True).start()
again(3)
print("heard", len(heard), "lost", len(lost), "wrong", len(wrong), "errors", len(errors))
