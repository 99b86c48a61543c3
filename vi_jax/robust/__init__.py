"""Robustness of motions: the minimal kick out of a basin, edge states, manifolds of saddles."""

from ._edge_state import EdgeState as EdgeState
from ._edge_state import edge_state as edge_state
from ._manifold import Manifold as Manifold
from ._manifold import manifold as manifold
from ._minimal_kick import MinimalKick as MinimalKick
from ._minimal_kick import minimal_kick as minimal_kick
