# %% [markdown]
# # First calls
#
# The first call in a process imports, traces and compiles, and takes much longer than the
# simulation. Here each program runs in fresh processes: without a cache of compiled programs, and
# with a warm one (`vi.keep_programs()`). The table lists the processor seconds of whole processes,
# which depend less on other work of the computer than the elapsed time does.
#
# Run with `python experiments/benchmarks/first_calls.py` (`--quick`: one run each, writes nothing).
# Another folder with a checkout of vi_jax as argument is measured in alternation.

# %%
import os
import platform
import resource
import statistics
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from tools.study import QUICK, say
from tools.tables import table

ROOT = Path(__file__).resolve().parents[2]
ROUNDS = 1 if QUICK else int(os.environ.get("ROUNDS", "5"))

BEGIN = """
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import vi_jax as vi
"""

MOTOR = """
motor = vi.Parameters().scene()
"""
SCENE = """
scene = vi.Scene.ideal(frequency_ratio=0.87, restitution=0.6, gap=2.0, damping_ratio=0.0)
"""
ORBIT = """
orbit = vi.find_orbit(scene, scene.start(Y=1.6, V=-1.9), cycles=2)
"""

OSCILLATOR = """
class Oscillator(vi.Mechanical):
    q = ("x",)
    cycle = 2 * jnp.pi

    def mass(self, q):
        return 1.0

    def force(self, t, q, v):
        return dict(x=-q.x - 0.1 * v.x + jnp.cos(t))

    contacts = vi.RigidStop(0.5, 0.7, on="x")

print(vi.simulate(Oscillator(), Oscillator().at(), 20).last)
"""

BODIES = """
class Bodies(vi.Mechanical):
    q = ("a", "b")
    cycle = 2 * jnp.pi

    def mass(self, q):
        return 1.0, 0.5

    def force(self, t, q, v):
        spring = 0.5 * (q.a - q.b)
        return dict(a=jnp.cos(t) - q.a - spring, b=spring - 0.3 * q.b)

    contacts = vi.RigidStop(0.3, 0.7, on="a"), vi.DryFriction(0.2, on="b")

print(vi.simulate(Bodies(), Bodies().at(), 20).last)
"""

BLOCK = """
class Block(vi.Mechanical):
    q = ("x", "y", "angle")
    width: float = 0.2
    height: float = 0.6
    cycle = 0.5

    def mass(self, q):
        return 1.0, 1.0, (self.width**2 + self.height**2) / 12

    @property
    def contacts(self):
        def corner(side):
            a, b = side * self.width / 2, self.height / 2
            gap = lambda q: q.y + a * jnp.sin(q.angle) - b * jnp.cos(q.angle)
            along = lambda q: q.x + a * jnp.cos(q.angle) + b * jnp.sin(q.angle)
            return vi.RigidStop(0.0, 0.3, "left", on=gap, friction=0.5, along=along)

        return corner(-1.0), corner(1.0)

    def force(self, t, q, v):
        return dict(x=2 * jnp.cos(4 * jnp.pi * t), y=-9.81, angle=0.0)

print(vi.simulate(Block(), Block().at(y=0.35), 20).last)
"""

DELAYED = """
class Cutter(vi.AbstractMachine):
    cycle: float = 2 * jnp.pi
    contacts = vi.RigidStop(0.5, 0.7, on=("x", "u"))
    delays = {"turn": 1.0}

    def field(self, t, z, past):
        return dict(x=z.u, u=jnp.cos(t) - z.x - 0.1 * z.u - 0.3 * (z.x - past.turn.x))

print(vi.simulate(Cutter(), vi.State(x=0.0, u=0.0), 20).last)
"""


def readme() -> str:
    """Return the example of the README, without its picture."""
    text = (ROOT / "README.md").read_text(encoding="utf-8").partition("## Use it")[2]
    code = text.partition("```python")[2].partition("```")[0]
    return "\n".join(line for line in code.splitlines() if not line.startswith("axes"))


PROGRAMS = {
    "import": f"{BEGIN}\nvi.simulate, vi.Mechanical, vi.find_orbit",
    "paper's motor: `simulate`": f"{BEGIN}{MOTOR}\nvi.simulate(motor, motor.start(), 20)",
    "paper's scene: `find_orbit`": f"{BEGIN}{SCENE}{ORBIT}\nprint(orbit)",
    "paper's scene: `find_orbit`, `continue_orbit`": f"""{BEGIN}{SCENE}{ORBIT}
print(vi.continue_orbit(
    orbit, parameter="drive.frequency_ratio", bounds=(0.8, 0.95), progress=False))""",
    "paper's motor: `suggest_method`": f"{BEGIN}{MOTOR}\nvi.suggest_method(motor)",
    "oscillator with a stop: `simulate`": f"{BEGIN}{OSCILLATOR}",
    "two bodies with friction: `simulate`": f"{BEGIN}{BODIES}",
    "block on two corners with friction: `simulate`": f"{BEGIN}{BLOCK}",
    "delayed oscillator with a stop: `simulate`": f"{BEGIN}{DELAYED}",
    "README's example: `simulate`, `find_orbit`, gradient": readme(),
}


def seconds(program: str, root: Path, cache: str) -> float:
    """Return the processor time of a process that runs a program of a checkout."""
    environment = {k: v for k, v in os.environ.items() if "CACHE" not in k and "PYTHON" not in k}
    environment |= {"PYTHONPATH": str(root), "JAX_PLATFORMS": "cpu"}
    if cache:
        environment |= {
            "JAX_COMPILATION_CACHE_DIR": cache, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }  # fmt: skip
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-c", program]
    # The working folder precedes `PYTHONPATH`.
    subprocess.run(command, env=environment, cwd=root, stdout=subprocess.DEVNULL, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


# %%
def main() -> None:
    roots = [ROOT, *(Path(x).resolve() for x in sys.argv[1:] if not x.startswith("-"))]
    rows = []
    with TemporaryDirectory() as folder:
        for name, program in PROGRAMS.items():
            found: dict[tuple[Path, str], list[float]] = {}
            for place, root in enumerate(roots):
                seconds(program, root, f"{folder}/{place}")  # fills the cache
            for _ in range(ROUNDS):
                for place, root in enumerate(roots):
                    for cache in ("", f"{folder}/{place}"):
                        taken = seconds(program, root, cache)
                        found.setdefault((root, cache), []).append(taken)
            medians = [f"{statistics.median(x):.1f}" for x in found.values()]
            say(f"{name}: {', '.join(medians)}")
            rows.append([name, *medians])
    if QUICK or len(roots) > 1:
        return
    import jax

    text = f"""# First calls

Processor seconds of a fresh process, imports included; number of runs of which the median is
taken: {ROUNDS}. Python {platform.python_version()}, JAX {jax.__version__}. The second column is
with the programs of an earlier process (`vi.keep_programs()`).

{table(["program", "without a cache", "with a warm cache"], rows)}

The same for another checkout: `python experiments/benchmarks/first_calls.py FOLDER`.
"""
    Path(__file__).with_suffix(".md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
