"""Processor time and error of a driven oscillator with delayed feedback: vi_jax and JiTCDDE.

    x'' + 0.1 x' + x = cos 0.8t + 0.15 (x(t - 3) - x),   x = 0 for t ≤ 0,   50 cycles

JiTCDDE (`pip install jitcdde sympy`) compiles the equation to C. It has no impacts.
"""

import time
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import symengine  # pyright: ignore[reportMissingImports]
import vi_jax as vi
from jitcdde import jitcdde, t, y  # pyright: ignore[reportMissingImports]

jax.config.update("jax_enable_x64", True)
warnings.simplefilter("ignore")
END = 50 * 2 * np.pi / 0.8


class Held(vi.AbstractMachine):
    cycle = 2 * np.pi / 0.8
    delays = property(lambda self: dict(sensor=3.0))

    def field(self, t, z, past):
        pull = 0.15 * (past.sensor.x - z.x)
        return dict(x=z.u, u=jnp.cos(0.8 * t) - z.x - 0.1 * z.u + pull)


def fastest(run):
    times = []
    for _ in range(4):
        begin = time.process_time()
        run()
        times.append(time.process_time() - begin)
    return min(times)


def program(method, lanes):
    end = lambda x: vi.simulate(Held(), vi.State(x=x, u=0.0), 50, method=method).last
    run, x = jax.jit(jax.vmap(end)), jnp.zeros(lanes)
    return lambda: jax.block_until_ready(run(x)).x[0]


exact = program("reference", 1)()
for method in ("draft", "standard", "reference"):
    for lanes in (1, 1024):
        run = program(method, lanes)
        error, seconds = abs(float(run() - exact)), fastest(run) / lanes
        print(f"vi_jax {method}, {lanes} lanes: error {error:.1g}, {1e3 * seconds:.3g} ms each")

pull = 0.15 * (y(0, t - 3) - y(0))
field = [y(1), symengine.cos(0.8 * t) - y(0) - 0.1 * y(1) + pull]
compiler = jitcdde(field, max_delay=3.0, verbose=False)
compiler.compile_C(simplify=False)


def by_jitcdde(tolerance):
    compiler.purge_past()
    compiler.constant_past([0.0, 0.0], time=0.0)
    compiler.reset_integrator()
    compiler.set_integration_parameters(
        rtol=tolerance, atol=tolerance, first_step=0.01, max_step=1.0
    )
    compiler.step_on_discontinuities()
    return compiler.integrate(END)[0]


for tolerance in (1e-4, 1e-6, 1e-8, 1e-9):
    error = abs(float(by_jitcdde(tolerance) - exact))
    seconds = fastest(lambda tolerance=tolerance: by_jitcdde(tolerance))
    print(f"JiTCDDE, tolerance {tolerance}: error {error:.1g}, {1e3 * seconds:.3g} ms")
