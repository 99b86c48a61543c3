"""Functions of the C library as vector code agree with extended precision."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from vi_jax import lanes


def as_lanes(function, numbers):
    """Evaluate `function` in every lane with one kernel."""
    return jax.jit(jax.vmap(lambda few: lanes.once(function, few)))(numbers)


# Functions of the C library: in JAX, in extended precision, and ranges of their arguments.
LIBRARY = {
    "exp": (jnp.exp, np.exp, [(-2, 2), (-700, 700)]),
    "tanh": (jnp.tanh, np.tanh, [(-1, 1), (-25, 25)]),
    "expm1": (jnp.expm1, np.expm1, [(-2, 2), (-750, 750)]),
    "log1p": (jnp.log1p, np.log1p, [(-1, 1), (0, 50)]),
    "atan": (jnp.arctan, np.arctan, [(-1.5, 1.5), (-20, 20)]),
    "atan2": (lambda x: jax.lax.atan2(x, 0.3 - x), None, [(-1, 1), (-20, 20)]),
    "sinh": (jnp.sinh, np.sinh, [(-2, 2), (-711, 711)]),
    "cosh": (jnp.cosh, np.cosh, [(-2, 2), (-711, 711)]),
    "asin": (jax.lax.asin, np.arcsin, [(-1, 1), (0.45, 0.55)]),
    "acos": (jax.lax.acos, np.arccos, [(-1, 1), (0.45, 0.55)]),
    "tan": (jnp.tan, np.tan, [(-4, 4), (-1e5, 1e5), (-1e9, 1e9)]),
    "exp2": (jnp.exp2, np.exp2, [(-2, 2), (-1022, 1025)]),
    "cbrt": (jnp.cbrt, np.cbrt, [(-3, 3), (-1e9, 1e9)]),
    "erf": (jax.lax.erf, np.vectorize(math.erf, otypes=[float]), [(-1, 1), (-6, 6)]),
    "erfc": (jax.lax.erfc, np.vectorize(math.erfc, otypes=[float]), [(-1, 1), (0, 26.5)]),
    "atanh": (jax.lax.atanh, np.arctanh, [(-1, 1), (-0.1, 0.1)]),
    "asinh": (jnp.arcsinh, np.arcsinh, [(-3, 3), (-1e9, 1e9)]),
    "acosh": (jax.lax.acosh, np.arccosh, [(1, 3), (1, 1e9)]),
}
CORNERS = [
    0.0, 1.0, np.nextafter(1, 0), np.nextafter(1, 2), 0.5, np.pi / 2, 1e-300, 1e22, 1e300, 2.0**28,
    709.782712893384, 709.79, 710.475860073944, 720.0, 1024.0, 26.54, np.inf, np.nan,
]  # fmt: skip


def _units(value, wanted):
    """Return the error in units of the last place, or infinity for a wrong special value."""
    info = np.finfo(value.dtype)
    rounded = wanted.astype(value.dtype)
    same = (value == rounded) & (np.signbit(value) == np.signbit(rounded))
    same |= np.isnan(value) & np.isnan(rounded)
    same |= (np.abs(rounded) < info.tiny) & (np.abs(value) < info.tiny)  # flushed to zero
    finite = np.isfinite(value) & np.isfinite(rounded) & (value != 0) & (rounded != 0)
    last = np.ldexp(np.longdouble(1), np.frexp(np.where(finite, wanted, 1))[1] - 1 - info.nmant)
    error = np.abs(value - wanted) / np.maximum(last, info.smallest_subnormal)
    return np.where(same, np.where(finite, error, 0), np.where(finite, error, np.inf))


@pytest.fixture(scope="module", params=[np.float64, np.float32])
def library(request):
    """Return arguments and results of one kernel by the function's name, and the function."""
    rng = np.random.default_rng(6)

    def numbers(ranges):
        near = [np.concatenate([np.linspace(*r, 3001), rng.uniform(*r, 3001)]) for r in ranges]
        sizes = np.ldexp(rng.uniform(1, 2, 3000), rng.integers(-1021, 1023, 3000))
        few = np.concatenate([*near, sizes, np.ldexp(1.0, rng.integers(-40, 40, 500))])
        few = np.resize(np.concatenate([few, -few, CORNERS, np.negative(CORNERS)]), 44000)
        with np.errstate(over="ignore"):
            few = few.astype(request.param)
        return np.where(np.abs(few) < np.finfo(few.dtype).tiny, np.copysign(0, few), few)

    asked = {name: numbers(ranges) for name, (_, _, ranges) in LIBRARY.items()}

    def all_of(asked):
        return {name: LIBRARY[name][0](x) for name, x in asked.items()}

    found = jax.tree.map(np.asarray, as_lanes(all_of, asked))
    return asked, found, all_of


@pytest.mark.skipif(np.finfo(np.longdouble).nmant < 63, reason="no extended precision")
@pytest.mark.parametrize("name", LIBRARY)
def test_functions_of_the_library_are_accurate_to_two_units(name, library):
    x, value = (part[name] for part in library[:2])
    with np.errstate(all="ignore"):
        wide = x.astype(np.longdouble)
        if name == "atan2":
            wanted = np.arctan2(wide, (x.dtype.type(0.3) - x).astype(np.longdouble))
        else:
            wanted = LIBRARY[name][1](wide)
        units = _units(value, wanted)
    worst = np.argmax(units)
    most = 4 if name == "cbrt" else 2  # the error of the C library's `cbrt`
    assert units[worst] < (most if x.dtype == np.float64 else 0.51), x[worst]


def test_functions_of_the_library_do_not_depend_on_the_batch(library):
    asked, found, all_of = library
    for few in (slice(40, 43), slice(-48, -1)):
        narrow = as_lanes(all_of, {name: x[few] for name, x in asked.items()})
        for name, value in narrow.items():
            np.testing.assert_array_equal(value, found[name][few], err_msg=name)


@pytest.mark.skipif(np.finfo(np.longdouble).nmant < 63, reason="no extended precision")
@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_angles_of_all_quadrants(kind):
    """Compare `atan2` with NumPy for all signs and sizes."""
    rng = np.random.default_rng(7)
    some = [0.0, 1.0, 2.0, 1e-30, 1e30, np.inf, *rng.uniform(0, 2, 40), np.nan]
    y, x = (
        z.ravel().astype(kind)
        for z in np.meshgrid([*some, *np.negative(some)], [*some, *np.negative(some)])
    )
    value = np.asarray(as_lanes(lambda yx: jnp.arctan2(*yx), (y, x)))
    with np.errstate(all="ignore"):
        units = _units(value, np.arctan2(y.astype(np.longdouble), x.astype(np.longdouble)))
    assert units.max() < 2


@pytest.mark.skipif(np.finfo(np.longdouble).nmant < 63, reason="no extended precision")
@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_powers_are_accurate_to_two_units(kind):
    rng = np.random.default_rng(8)
    n, info = 20000, np.finfo(kind)
    some = [*CORNERS, 2.0, 3.0, -1.5, 0.25, 2.0**53 - 1, 2.0**53, 1e16, 1e-5]
    corners = np.meshgrid([*some, *np.negative(some)], [*some, *np.negative(some)])
    bases = [np.exp(rng.normal(0, 4, n)), rng.uniform(0.5, 2, n), 1 + rng.normal(0, 1e-3, n)]
    powers = [rng.normal(0, 20, n), rng.uniform(-1000, 1000, n), rng.normal(0, 3e5, n)]
    with np.errstate(all="ignore"):
        x = np.concatenate([*bases, corners[0].ravel()]).astype(kind)
        y = np.concatenate([*powers, corners[1].ravel()]).astype(kind)
        x, y = (np.where(np.abs(z) < info.tiny, np.copysign(0, z), z).astype(kind) for z in (x, y))
        value = np.asarray(as_lanes(lambda xy: jax.lax.pow(*xy), (x, y)))
        units = _units(value, np.power(x.astype(np.longdouble), y.astype(np.longdouble)))
    worst = np.argmax(units)
    assert units[worst] < (2 if kind == np.float64 else 0.51), (x[worst], y[worst])
