# %% [markdown]
"""# Simulate a machine and plot its motion

The machine of the paper's Table 1: a motor turns a crank, the crank shakes a body on a spring, and
the body hits a stop. The motion settles for 200 drive cycles, and the next two are drawn.
"""

# %%
import jax

jax.config.update("jax_enable_x64", True)
import matplotlib.pyplot as plt
import vi_jax as vi

# %% The scene: Table 1 in SI units, made dimensionless (length a, time 1/ω)
machine = vi.Parameters(torque=10.0, restitution=0.5, gap=0.08)
scene = machine.scene(drive="motor")
settled = vi.simulate(scene, scene.start(), cycles=200)
print(settled)

# %% Two more cycles from the last state, with dense samples and a log of the impacts
run = vi.simulate(scene, settled.last, cycles=2, samples=200, impact_log=4)
assert run.impact_log is not None  # set by `impact_log=4`
speed = float(machine.metres_per_second(run.impact_log.speed[0, 0]))
print(f"hits the stop at {speed:.2f} m/s")

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
vi.plot_history(run, machine=scene, ax=left)
vi.plot_phase_portrait(run, scene, ax=right)
left.set_title("position over the crank angle; green: the stop")
right.set_title("phase portrait; dots: after each cycle")
left.set_ylabel("position Y (unit: crank radius a)")
right.set(xlabel="position Y (a)", ylabel="velocity V (a ω)")
figure.savefig("simulate.png")
