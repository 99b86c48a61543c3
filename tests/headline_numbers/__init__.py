"""The studies' headline numbers, computed with the library as it is, by cheaper ways.

Each function gives numbers by the names under which the study of that name keeps them, with the
difference that is allowed.
"""

from .benchmarks import chains, explorer, gradients, peers, scene_cost, speed_accuracy
from .closed_forms import XI, Expected, closed
from .machines import dc_motor, known_machines, noise, relief_valve, sommerfeld, woodpecker
from .orbits import (
    all_orbits,
    basins_map,
    design_percussion,
    escape_from_2pi,
    fit_4pi_orbit,
    grazing_forecast,
    robustness,
    soft_stop,
)
from .paper import (
    bifurcation_diagram,
    boundaries,
    codimension_two,
    fig2_frequency_response,
    motor_frequency_response,
    regime_maps,
    why_four_pi,
)
from .records import identify, learned_laws, posterior

__all__ = [
    "XI",
    "Expected",
    "all_orbits",
    "basins_map",
    "bifurcation_diagram",
    "boundaries",
    "chains",
    "closed",
    "codimension_two",
    "dc_motor",
    "design_percussion",
    "escape_from_2pi",
    "explorer",
    "fig2_frequency_response",
    "fit_4pi_orbit",
    "gradients",
    "grazing_forecast",
    "identify",
    "known_machines",
    "learned_laws",
    "motor_frequency_response",
    "noise",
    "peers",
    "posterior",
    "regime_maps",
    "relief_valve",
    "robustness",
    "scene_cost",
    "soft_stop",
    "sommerfeld",
    "speed_accuracy",
    "why_four_pi",
    "woodpecker",
]
