"""The loop over lanes, with toys: a logistic map and a ball that falls until it hits the floor."""

import ast
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from functools import partial, wraps
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax
from hypothesis import given, settings
from hypothesis import strategies as st
from vi_jax import lanes
from vi_jax.lanes import _code, _primitive, runtime
from vi_jax.lanes.runtime import thread_count

ROWS = 12


def logistic(x, r, n, *, backend=None):
    """n steps of x ← r x (1 - x) with a rare branch; a row for every step."""

    def begin(inputs):
        x, _, n = inputs
        return (x, jnp.zeros_like(x)), lanes.Emitted(n > 0, True, {"x": x, "steps": 0})

    def step(inputs, carry):
        _, r, n = inputs
        x, done = carry
        x = r * x * (1 - x)
        x = jax.lax.cond(x > 0.9, lambda x: 0.9 + 0.1 * jnp.sin(x - 0.9), lambda x: x, x)
        done = done + 1
        row = {"x": x, "steps": done.astype(jnp.int32)}
        return (x, done), lanes.Emitted(done < n, True, row)

    def end(inputs, carry):
        return carry[0], carry[1].astype(jnp.int32)

    return lanes.run(begin, step, end, (x, r, n), rows=ROWS, backend=backend)


def fall(height, gravity, h=0.05, *, backend=None):
    """A ball falls in steps of h until an event: time and speed when it hits the floor."""

    def begin(inputs):
        height, _ = inputs
        return (height, 0 * height, 0 * height), lanes.Emitted(True, False, height)

    def step(inputs, carry):
        _, gravity = inputs
        x, v, t = carry
        x1, v1 = x + v * h - 0.5 * gravity * h * h, v - gravity * h
        hits = x1 <= 0
        left = (v + jnp.sqrt(v * v + 2 * gravity * jnp.maximum(x, 0.0))) / gravity
        carry = (
            jnp.where(hits, 0.0, x1), jnp.where(hits, v - gravity * left, v1),
            t + jnp.where(hits, left, h),
        )  # fmt: skip
        return carry, lanes.Emitted(~hits, hits, carry[1])

    def end(inputs, carry):
        return carry[2], carry[1]

    return lanes.run(begin, step, end, (height, gravity), rows=1, backend=backend)


MANY = jax.jit(jax.vmap(logistic))


def batch(size):
    draw = np.random.default_rng(size).uniform
    return draw(0.1, 0.9, size), draw(2.5, 3.99, size), np.floor(draw(0, 16, size))


def plain(x, r, n):
    """The same map in numpy, one lane at a time."""
    out = [x]
    for _ in range(int(n)):
        x = r * x * (1 - x)
        x = 0.9 + 0.1 * np.sin(x - 0.9) if x > 0.9 else x
        out.append(x)
    return out


@pytest.mark.parametrize("size", [0, 1, 2, 7, 8, 9, 101, 1000])
def test_every_batch(size):
    x, r, n = batch(size)
    (last, steps), rows = MANY(x, r, n)
    assert last.shape == (size,) and rows["x"].shape == (size, ROWS)
    np.testing.assert_array_equal(steps, n)
    for i in range(0, size, max(1, size // 20)):
        expected = plain(x[i], r[i], n[i])
        np.testing.assert_allclose(last[i], expected[-1], rtol=1e-9)
        kept = np.full(ROWS, np.nan)
        kept[: len(expected)] = expected[:ROWS]
        np.testing.assert_allclose(rows["x"][i], kept, rtol=1e-9)
        assert rows["steps"][i, min(len(expected), ROWS) - 1] == min(len(expected), ROWS) - 1


def test_roads_agree():
    for size in (1, 7, 600):
        values = batch(size)
        other = jax.jit(jax.vmap(lambda *a: logistic(*a, backend="xla")))(*values)
        for a, b in zip(jax.tree.leaves(MANY(*values)), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-13)


def test_the_road_of_the_context():
    with lanes.backend("xla"):
        jaxpr = jax.make_jaxpr(lambda x: logistic(x, 3.0, 4.0))(0.5)
    assert "backend=xla" in str(jaxpr)
    with pytest.raises(ValueError, match="name"), lanes.backend("motorway"):
        pass


@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.data())
def test_lanes_know_nothing_of_each_other(data):
    """To the last bit, whatever lanes go along, how many, in whatever order, on however many
    threads."""
    size = 64 * lanes.cores() + 19  # in wide groups
    values = batch(size)
    with lanes.threads(1):
        whole = jax.tree.leaves(MANY(*values))
    chosen = data.draw(st.lists(st.integers(0, size - 1), min_size=1, max_size=40))
    chosen = np.resize(chosen, data.draw(st.sampled_from([3, 7, 40])))  # three programs
    with lanes.threads(data.draw(st.integers(1, 4))):
        part = jax.tree.leaves(MANY(*(x[chosen] for x in values)))
    for a, b in zip(whole, part, strict=True):
        np.testing.assert_array_equal(np.asarray(a)[chosen], b)


def test_threads_hold_on_threads_of_no_context():
    """As XLA's own are, on which it runs larger programs."""

    def told():
        with ThreadPoolExecutor(1) as pool:
            return pool.submit(thread_count).result()

    with lanes.threads(3):
        assert told() == thread_count() == 3
        with lanes.threads(1):
            assert told() == thread_count() == 1
        assert told() == 3
    assert told() == thread_count() == lanes.cores()


def test_nested_and_shared_axes():
    x, r, _ = batch(6)
    flat = MANY(np.repeat(x, 5), np.tile(r[:5], 6), np.full(30, 9.0))
    both = jax.vmap(jax.vmap(logistic, (None, 0, None)), (0, None, None))(x, r[:5], 9.0)
    swapped = jax.vmap(jax.vmap(logistic, (0, None, None)), (None, 0, None))(x, r[:5], 9.0)
    for a, b, c in zip(*map(jax.tree.leaves, (flat, both, swapped)), strict=True):
        np.testing.assert_array_equal(a.reshape(b.shape), b)
        np.testing.assert_array_equal(b, np.swapaxes(c, 0, 1))


def test_a_ball_falls():
    height = np.linspace(0.1, 5, 50)
    (time, speed), rows = jax.vmap(fall, (0, None))(height, 9.81)
    np.testing.assert_allclose(time, np.sqrt(2 * height / 9.81), rtol=1e-13)
    np.testing.assert_allclose(speed, -np.sqrt(2 * height * 9.81), rtol=1e-13)
    np.testing.assert_array_equal(rows[:, 0], speed)


def test_forward_derivatives():
    """Through the event, in one direction and in several, of first and second order."""
    time = lambda height, gravity: fall(height, gravity)[0][0]
    h, g = 1.7, 9.81
    slope = jax.jacfwd(time, (0, 1))(h, g)
    np.testing.assert_allclose(slope, [0.5 * np.sqrt(2 / h / g), -0.5 * np.sqrt(2 * h / g**3)])
    bend = jax.jacfwd(jax.jacfwd(time))(h, g)
    np.testing.assert_allclose(bend, -0.25 * np.sqrt(2 / h**3 / g))
    many = jax.vmap(jax.jacfwd(time, (0, 1)), (0, None))(np.linspace(1, 2, 11), g)
    np.testing.assert_allclose(many[0], 0.5 * np.sqrt(2 / np.linspace(1, 2, 11) / g))
    one = jax.jit(lambda x: jax.jvp(lambda x: logistic(x, 3.7, 6.0), (x,), (1.0,)))(0.3)
    two = jax.jit(lambda x: jax.jvp(lambda x: logistic(x, 3.7, 6.0, backend="xla"), (x,), (1.0,)))(
        0.3
    )
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        if a.dtype != jax.dtypes.float0:
            np.testing.assert_allclose(a, b, rtol=1e-12)


def test_directions_share_one_motion():
    """Six directions make one program whose primal part is there once."""
    rows = jax.make_jaxpr(jax.jacfwd(lambda x: logistic(*x, backend="xla")[1]["x"]))(
        jnp.asarray([0.3, 3.7, 6.0])
    )
    equations = [e for e in rows.jaxpr.eqns if e.primitive.name == "lanes"]
    assert len(equations) == 1 and equations[0].outvars[0].aval.shape == ()


INNER = {
    "scan": lambda x: jax.lax.scan(lambda a, b: (a * b, a), x, jnp.stack([x, 2 * x]))[0],
    "fori_loop": lambda x: jax.lax.fori_loop(0, 3, lambda i, a: a * a, x),
    "while_loop": lambda x: jax.lax.while_loop(lambda a: a < 5, lambda a: a * a, x),
    "cond": lambda x: jax.lax.cond(x > 1, lambda a: a * a, lambda a: a, x),
    "checkpoint": lambda x: jax.checkpoint(jnp.sin)(x),
    "custom_jvp": lambda x: with_its_own_derivative(x),
}


@jax.custom_jvp
def with_its_own_derivative(x):
    return jax.lax.stop_gradient(x)


with_its_own_derivative.defjvps(lambda slope, out, x: 3 * x * slope)


@pytest.mark.parametrize("name", INNER)
def test_derivatives_of_a_step_that_holds(name):
    def lane(x, y):
        def begin(inputs):
            return inputs[0], lanes.Emitted(True, False, None)

        def step(inputs, carry):
            return INNER[name](carry) * inputs[1], lanes.Emitted(False, False, None)

        return lanes.run(begin, step, lambda inputs, carry: carry, (x, y), rows=0)[0]

    def plain(x, y):
        return INNER[name](x) * y

    wanted = jax.jit(jax.jacfwd(plain, (0, 1)))(1.5, 2.5)
    for along in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(along(lane, (0, 1)))(1.5, 2.5), wanted, rtol=1e-15)


@pytest.mark.slow
def test_reverse_mode_is_the_forward_one_transposed():
    """Of results and rows, of all inputs or some, of numbers of a lane's own and of common ones."""

    def sums(x, r, backend=None):
        (last, *_), rows = jax.vmap(lambda x: logistic(x, r, 6.0, backend=backend))(x)
        return jnp.stack([jnp.sum(jnp.sin(last)), jnp.sum(rows["x"][:, :3] ** 2)])

    x = jnp.linspace(0.1, 0.9, 11)
    for backend in (None, "xla"):
        for which in (0, 1):
            forward = jax.jacfwd(sums, which)(x, 3.7, backend)
            backward = jax.jacrev(sums, which)(x, 3.7, backend)
            np.testing.assert_allclose(backward, forward, rtol=1e-12, atol=1e-12)
    many = jnp.linspace(0.1, 0.9, 20)
    slope = jax.grad(lambda w: jnp.sum(jnp.sin(logistic(w @ many, 3.7, 6.0)[0][0])))(
        jnp.ones(20) / 40
    )
    np.testing.assert_allclose(slope / many, slope[0] / many[0], rtol=1e-12)


def test_values_beside_a_gradient_and_linear_parts():

    def last(x):
        return logistic(x, 3.7, 6.0)[0][0]

    value, along = jax.linearize(last, 0.3)
    np.testing.assert_allclose(value, last(0.3))
    np.testing.assert_allclose(along(1.0), jax.jacfwd(last)(0.3))
    slope = jax.grad(lambda x: x * jax.lax.stop_gradient(last(x)) + 0 * last(0.3 + 0 * x) ** 0)
    np.testing.assert_allclose(slope(0.3), last(0.3))


def test_closed_over_arrays_are_inputs():
    """Numbers that the functions close over may be traced, batched and differentiated."""

    def shifted(offset):
        def begin(x):
            return x + offset, lanes.Emitted(True, False, None)

        def step(x, carry):
            return carry * offset, lanes.Emitted(jnp.abs(carry) > 1.0, False, None)

        return lanes.run(begin, step, lambda x, carry: carry, 3.0, rows=0)[0]

    offsets = jnp.asarray([0.5, 0.25, 0.1])
    loop = []
    for o in [0.5, 0.25, 0.1]:
        value = 3.0 + o
        going = True
        while going:
            going, value = abs(value) > 1.0, value * o
        loop.append(value)
    np.testing.assert_allclose(jax.vmap(shifted)(offsets), loop)
    slope = jax.vmap(jax.jacfwd(shifted))(offsets)
    h = 1e-6
    change = jax.vmap(shifted)(offsets + h) - jax.vmap(shifted)(offsets - h)
    np.testing.assert_allclose(slope, change / (2 * h), rtol=1e-7)


def test_single_precision():
    values = [x.astype(np.float32) for x in batch(50)]
    values[2] = np.minimum(values[2], 5)
    (last, _), rows = MANY(*values)
    assert last.dtype == np.float32 and rows["x"].dtype == np.float32
    wide = MANY(*(x.astype(float) for x in values))
    np.testing.assert_allclose(last, wide[0][0], rtol=2e-4)


@pytest.mark.parametrize("cpu", ["x86-64-v3", "x86-64-v2", "x86-64"])
def test_lesser_processors(cpu):
    import platform

    if platform.machine() not in ("x86_64", "AMD64"):
        pytest.skip("another architecture")
    values = batch(33)
    with lanes.processor(cpu):
        mine = jax.jit(jax.vmap(logistic))(*values)
    for a, b in zip(jax.tree.leaves(mine), jax.tree.leaves(MANY(*values)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9)


def sorting(x, *, backend=None):
    def begin(x):
        return x, lanes.Emitted(True, False, None)

    def step(x, carry):
        return jnp.sort(jnp.stack([carry, 1.0]))[0], lanes.Emitted(False, False, None)

    return lanes.run(begin, step, lambda x, carry: carry, x, rows=0, backend=backend)[0]


def test_shards_of_a_batch_take_the_same_road():
    """`shard_map` marks what lanes share, zeros of derivatives included; that is no computation."""
    mesh = jax.sharding.Mesh(np.asarray(jax.devices()[:1]), ("lanes",))
    split = jax.sharding.PartitionSpec("lanes")
    heights = jnp.linspace(0.5, 2.0, 13)

    def both(height):
        return jax.jvp(lambda x: fall(x, 9.81)[0], (height,), (jnp.ones_like(height),))

    def sharded(x):
        return jax.shard_map(
            jax.vmap(both), mesh=mesh, in_specs=split, out_specs=split, check_vma=False
        )(x)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = jax.jit(sharded)(heights)
    for a, b in zip(found, jax.vmap(both)(heights), strict=True):
        np.testing.assert_array_equal(a, b)


def test_what_has_no_vector_form_takes_the_other_road_and_says_so():

    _primitive._warn.cache_clear()
    with pytest.warns(UserWarning, match="`sort`"):
        out = jax.vmap(sorting)(jnp.asarray([0.5, 3.0]))
    np.testing.assert_array_equal(out, [0.5, 1.0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # once
        jax.vmap(sorting)(jnp.asarray([0.5, 3.0, 4.0]))
        jax.vmap(lambda x: sorting(x, backend="xla"))(jnp.asarray([0.5, 3.0]))


def failing(*_):
    raise RuntimeError("no such instruction")


@pytest.mark.parametrize("fault", ["missing", "broken"])
def test_without_llvm(fault, monkeypatch):
    for cached in (_primitive._warn, _code.llvm, runtime._register_bits):
        cached.cache_clear()
    if fault == "missing":
        monkeypatch.setitem(sys.modules, "llvmlite.binding", None)
    else:
        monkeypatch.setattr(_code, "object_code", failing)
    try:
        with pytest.warns(UserWarning, match="llvmlite" if fault == "missing" else "LLVM: no such"):
            out = jax.vmap(lambda x: fall(x, 9.8125)[0][0])(jnp.linspace(1.0, 2.0, 5))
    finally:
        _code.llvm.cache_clear()
        runtime._register_bits.cache_clear()
    np.testing.assert_allclose(out, np.sqrt(2 * np.linspace(1, 2, 5) / 9.8125), rtol=1e-12)


def test_a_program_that_llvm_cannot_compile(monkeypatch):
    def begin(x):
        return x, lanes.Emitted(True, False, None)

    def step(x, carry):
        return carry + 0.15625, lanes.Emitted(False, False, None)

    _code.llvm()  # which it can do at first
    monkeypatch.setattr(_code, "object_code", failing)
    with pytest.raises(jax.errors.JaxRuntimeError, match=r"LLVM: no such.*backend\(.xla.\)"):
        jax.block_until_ready(lanes.run(begin, step, lambda x, carry: carry, 1.0, rows=0)[0])


def test_programs_are_kept_where_jax_keeps_its_own(monkeypatch, tmp_path):
    def fallen():
        kernel = runtime.Kernel("define void @kernel() { ret void }", None, 8)
        return kernel._call

    monkeypatch.setattr(_code, "_cache_folder", lambda: tmp_path)
    fallen()
    (kept,) = tmp_path.rglob("*.o")
    content = kept.read_bytes()
    with monkeypatch.context() as patched:
        patched.setattr(_code, "object_code", failing)
        fallen()  # from the file
        kept.write_bytes(content[:-1])
        with pytest.raises(RuntimeError, match="LLVM: no such"):
            fallen()
    fallen()
    assert kept.read_bytes() == content


def test_where_programs_are_kept(tmp_path):
    before = jax.config.jax_compilation_cache_dir  # pyright: ignore
    try:
        jax.config.update("jax_compilation_cache_dir", str(tmp_path))
        assert _code._cache_folder() == tmp_path / "vi_jax_lanes"
        jax.config.update("jax_compilation_cache_dir", "gs://far/away")
        assert _code._cache_folder() is None
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def test_what_a_step_must_give():
    def begin(x):
        return x, lanes.Emitted(True, False, None)

    def step(x, carry):
        return (carry, carry), lanes.Emitted(False, False, None)

    with pytest.raises(TypeError, match="carry of the structure"):
        lanes.run(begin, step, lambda x, carry: carry, 1.0, rows=0)


def test_programs_are_not_kept_for_ever():
    """Many programs in one process, each used once: memory maps and kernels stay few."""
    maps = Path("/proc/self/maps")

    def one(number):
        def begin(x):
            return x, lanes.Emitted(True, False, None)

        def step(x, carry):
            return carry + number, lanes.Emitted(False, False, None)

        return lanes.run(begin, step, lambda x, carry: carry, 1.0, rows=0)[0]

    def kernels(numbers):
        from vi_jax.lanes.runtime import kernel_of

        for number in numbers:
            jaxpr = jax.make_jaxpr(lambda: one(float(number)))().jaxpr  # noqa: B023
            kernel_of(
                next(e for e in jaxpr.eqns if e.primitive.name == "lanes").params["program"], 1
            )

    kernels(range(80))
    before = maps.read_bytes().count(b"\n") if maps.exists() else 0
    kernels(range(80, 240))
    after = maps.read_bytes().count(b"\n") if maps.exists() else 0
    assert after - before < 160
    assert len(runtime._recent) <= runtime._MOST_KERNELS


def test_the_room_stands_alone():
    """Nothing in it comes from the rest of the package."""
    folder = Path(vi_jax.__file__).parent / "lanes"
    for file in folder.glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom):
                assert node.level <= 1, f"{file.name} imports {node.module}"
                assert not (node.module or "").startswith(("vi_jax", "jax._src"))


def _sum(bound, x):
    return x + bound["offset"] if isinstance(bound["offset"], float) else x - bound["offset"]


@pytest.mark.slow
@pytest.mark.parametrize("same", [True, False])
def test_what_is_bound_to_a_function_tells_programs_apart(same):
    """Equal constants make one program, and what only compares equal makes another."""

    def found(offset):
        jaxpr = jax.make_jaxpr(lambda x: lanes.once(partial(_sum, {"offset": offset}), x))(1.0)
        (eqn,) = (e for e in jaxpr.jaxpr.eqns if e.primitive.name == "lanes")
        return eqn.params["program"]

    if same:
        assert found(2.0) is found(2.0) and found(2) is found(2)
        assert found(np.array([1.0, 2.0])[1]) is found(np.float64(2.0))
        return
    several = 1.0, 1, True, np.float32(1.0), 0.0, -0.0, 0, np.float32(-0.0), Metres(1.29)
    programs = [found(x) for x in (*several, Metres(1.31), 0j, complex(0.0, -0.0))]
    assert len(set(map(id, programs))) == len(programs)
    x = jnp.asarray(3.0)
    assert lanes.once(partial(_sum, {"offset": 1.0}), x) == 4.0
    assert lanes.once(partial(_sum, {"offset": 1}), x) == 2.0


class Metres(float):
    """A number that shows less than it is."""

    def __repr__(self):
        return f"{float(self):.1f} m"


FACTOR = 2.0


def _scaled(x):
    return FACTOR * x


def test_what_jax_forgets_is_forgotten(monkeypatch):
    x = jnp.asarray(3.0)
    assert lanes.once(_scaled, x) == 6.0
    monkeypatch.setitem(globals(), "FACTOR", 5.0)
    jax.clear_caches()
    assert lanes.once(_scaled, x) == 15.0


def test_a_decorated_function_is_what_decorates_it():
    def times(box):
        @wraps(_scaled)
        def wrapper(x):
            return box[0] * x

        return wrapper

    box, x = [2.0], jnp.asarray(3.0)
    scaled = times(box)
    assert lanes.once(scaled, x) == 6.0
    box[0] = 5.0
    assert lanes.once(scaled, x) == 15.0


def test_what_is_traced_is_not_kept():
    """A function bound as a constant may close over numbers that vary."""

    def along(k):
        return lanes.once(partial(_applied, Law(lambda x: k * x)), jnp.asarray(2.0))

    np.testing.assert_allclose(jax.vmap(along)(jnp.arange(3.0)), [0.0, 2.0, 4.0])
    np.testing.assert_allclose(jax.grad(along)(1.5), 2.0)
    np.testing.assert_allclose([along(k) for k in (1.0, jnp.asarray(4.0))], [2.0, 8.0])


class Law:
    """A plain object that holds a function."""

    def __init__(self, function):
        self.function = function


def _applied(law, x):
    return law.function(x)
