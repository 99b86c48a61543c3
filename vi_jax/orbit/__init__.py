"""Periodic motion: closed-form solutions."""

from .closed_form import ClosedFormOrbits as ClosedFormOrbits
from .closed_form import closed_form_orbits as closed_form_orbits
