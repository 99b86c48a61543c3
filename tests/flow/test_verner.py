"""Verner's tableau satisfies its order conditions, one for each rooted tree."""

import functools
import itertools
import subprocess
import sys

import diffrax
import jax
import numpy as np
import pytest
import vi_jax as vi

TABLEAU = vi.Verner9.tableau
NUMBER = len(TABLEAU.b_sol)
A = np.zeros((NUMBER, NUMBER))
for i, row in enumerate(TABLEAU.a_lower, start=1):
    A[i, : len(row)] = row


@functools.cache
def trees(order: int) -> list[tuple]:
    """Return the rooted trees of an order, each as the sorted tuple of its root's subtrees."""
    found = {()} if order == 1 else set()
    for parts in partitions(order - 1, order - 1):
        for children in itertools.product(*(trees(size) for size in parts)):
            found.add(tuple(sorted(children)))
    return sorted(found)


def partitions(total: int, largest: int):
    """Yield the partitions of a number, largest part first."""
    if total == 0:
        yield ()
    for first in range(min(total, largest), 0, -1):
        for rest in partitions(total - first, first):
            yield (first, *rest)


@functools.cache
def size(tree: tuple) -> int:
    return 1 + sum(map(size, tree))


@functools.cache
def density(tree: tuple) -> int:
    return size(tree) * int(np.prod([density(x) for x in tree], dtype=object))


@functools.cache
def weights(tree: tuple) -> np.ndarray:
    """Return the elementary weights of the stages."""
    return np.prod([A @ weights(x) for x in tree], axis=0) if tree else np.ones(NUMBER)


def worst(b: np.ndarray, order: int) -> float:
    """Return the largest residual of the conditions of one order."""
    return max(abs(b @ weights(tree) - 1 / density(tree)) for tree in trees(order))


def test_number_of_trees_matches_butcher():
    assert [len(trees(n)) for n in range(1, 11)] == [1, 1, 2, 4, 9, 20, 48, 115, 286, 719]


@pytest.mark.parametrize(
    "b, order",
    [(TABLEAU.b_sol, 9), (TABLEAU.b_sol - TABLEAU.b_error, 8)],
    ids=["solution", "estimate"],
)
def test_order_conditions(b, order):
    """Conditions up to the order hold to rounding; some of the next order do not."""
    assert max(worst(b, n) for n in range(1, order + 1)) < 2e-15
    assert worst(b, order + 1) > 1e-8


def test_is_a_diffrax_solver_that_is_loaded_when_used():
    solver = vi.Verner9()
    assert isinstance(solver, diffrax.AbstractERK) and solver.order(None) == 9
    # One program for both.
    structures = [jax.tree.structure(vi.Adaptive(*x)) for x in ([], [solver])]
    assert structures[0] == structures[1]
    slow = "('diffrax', 'lineax', 'optimistix', 'optax', 'scipy', 'matplotlib')"
    run = f"""
import sys, vi_jax as vi
scene = vi.Scene.ideal(frequency_ratio=0.87, restitution=0.6, gap=2.0, damping_ratio=0.0)
print(vi.find_orbit(scene, scene.start(Y=1.6, V=-1.9), cycles=2).result)
print([x for x in {slow} if x in sys.modules])"""
    out = subprocess.run([sys.executable, "-c", run], capture_output=True, text=True, check=True)
    assert out.stdout.split() == ["ORBIT_RESULTS.successful", "[]"]
