"""A scan of a few seconds into a store, to be interrupted: `long_scan.py STORE [options]`."""

import argparse

import jax
import numpy as np

AXES = {"drive.frequency_ratio": np.linspace(0.6, 1.4, 64), "start.Y": np.linspace(-1, 1, 64)}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("store")
    parser.add_argument("--devices", type=int, default=1)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", options.devices)
    import vi_jax as vi

    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.8, gap=2.0)
    block = {**AXES, "drive.frequency_ratio": AXES["drive.frequency_ratio"][:8]}
    vi.scan(scene, block, settle=800, lanes=512, workers=2)  # compile
    print("begins", flush=True)
    vi.scan(scene, AXES, settle=800, lanes=512, workers=2, store=options.store)
    print("ends", flush=True)


if __name__ == "__main__":
    main()
