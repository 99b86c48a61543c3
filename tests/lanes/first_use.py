"""Two threads use lanes for the first time at once; a script of `test_interrupts.py`."""

import threading

import jax

jax.config.update("jax_enable_x64", True)
import vi_jax as vi
from vi_jax.lanes import _interrupts
from vi_jax.lanes.call import register_handler

made, both = _interrupts.engine_of, threading.Barrier(2)
engines = []


def slowly(text):
    engines.append(made(text))
    threading.Event().wait(0.2)  # the other thread arrives during this time
    return engines[-1]


def first():
    both.wait()
    register_handler()


_interrupts.engine_of = slowly
threads = [threading.Thread(target=first) for _ in range(2)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0)
assert bool(vi.simulate(scene, scene.start(), 3).successful)
print(len(engines))
