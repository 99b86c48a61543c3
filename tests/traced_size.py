"""How large a traced program is."""

from collections import Counter
from typing import Any


def primitives(jaxpr: Any) -> Counter:
    """Primitives of a jaxpr and of all that it calls, by name."""
    found: Counter = Counter()
    for equation in jaxpr.eqns:
        found[equation.primitive.name] += 1
        for parameter in equation.params.values():
            parameter = getattr(parameter, "jaxprs", parameter)  # of a loop over lanes
            for inner in parameter if isinstance(parameter, tuple | list) else (parameter,):
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    found += primitives(inner)
    return found
