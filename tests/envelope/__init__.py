"""The envelope: corners of parameter space, each beside an expectation that owes nothing to the
package.

That is a closed form, an energy, a limit, a symmetry, or a run by SciPy (matrix exponentials
between impacts for the ideal drive, `solve_ivp` with events for the motor). What is measured is
the largest deviation from it, beside what is promised. `test_extremes.py` holds the package to
these rows.
"""

from . import frequency, gaps, motors, numbers, restitution
from .case import MADE

_ORDER = (restitution, frequency, gaps, motors, numbers)
CASES = [row for part in _ORDER for row in MADE if row.measure.__module__ == part.__name__]
