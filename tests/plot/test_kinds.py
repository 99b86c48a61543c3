"""Every kind of special points and of curves can be drawn."""

from types import SimpleNamespace

import numpy as np
import pytest
import vi_jax as vi
from matplotlib.figure import Figure
from vi_jax.orbit import KINDS
from vi_jax.orbit.kinds import FOLLOWED

SCENE = vi.Scene.ideal(frequency_ratio=0.9)


class Drawn(vi.Boundary):
    """A boundary of a line, with a special point of each kind."""

    names = ("stops.0.gap", "stops.0.restitution")
    parameters = np.array([[1.0, 0.2], [2.0, 0.8]])
    impact_speed = np.zeros((2, 1))
    special = tuple(SimpleNamespace(kind=k, parameters=np.array([1.5, 0.5])) for k in KINDS)


@pytest.mark.parametrize("kind", FOLLOWED)
def test_curves_of_every_kind_are_drawn(kind):
    problem = SimpleNamespace(cycles=1, machine=SCENE, conditions=(SimpleNamespace(kind=kind),))
    curve = Drawn(problem=problem, steps=[], ends=("bounds", "bounds"))
    ax = vi.plot_boundary(curve, ax=Figure().subplots())
    labels = [line.get_label() for line in ax.lines]
    assert labels[0] == kind and set(KINDS) <= set(labels)
    dashes = [row.dash for row in KINDS.values() if row.dash is not None]
    assert len({str(dash) for dash in dashes}) == len(dashes) == len(FOLLOWED)
