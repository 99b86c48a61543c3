"""How ready machines are drawn, each by the method `sketch` of its class and a `Pen`."""

from math import cos, sin
from typing import Any

from .._types import State
from ..machine import stops_of


def draw_ball(machine: Any, pen: Any, state: State, phase: float) -> None:
    """A ball above its table."""
    radius, table = 0.3 * pen.size, -float(machine.acceleration) * cos(phase)
    wide = 2.4 * pen.size
    pen.body(0.0, table - 0.15 * pen.size, width=wide, height=0.3 * pen.size, color=pen.green)
    pen.ball(0.0, table + radius + float(state.height), radius)
    pen.arrow((-0.7 * wide, 0.35 * pen.size), (-0.7 * wide, -0.35 * pen.size))
    pen.label(-0.7 * wide, 0.6 * pen.size, "$g$")
    pen.label(0.62 * wide, table, "$-\\Gamma\\,\\cos\\,\\omega t$", ha="left", color=pen.green)


def draw_pair(machine: Any, pen: Any, state: State, phase: float) -> None:
    """A box with a ball in it."""
    free = machine.mass_ratio is not None
    box = float(state.box) if free else sin(phase)
    radius, half = 0.4 * pen.size, float(machine.half_gap)
    wall = 0.25 * pen.size
    height = 3.2 * radius
    base = -height / 2
    for sign in (-1, 1):
        face = box + sign * (half + radius + wall / 2)
        pen.body(face, width=wall, height=height, color=pen.green)
    pen.body(box, base - wall / 2, width=2 * (half + radius + wall), height=wall, color=pen.green)
    pen.ball(box + float(state.place), base + radius, radius)
    pen.floor(-2.2 * half - 2.0, 2.2 * half + 2.0, base - wall)
    edge = half + radius + wall
    if free:
        post = -edge - pen.reach - 1.6
        pen.spring((post, 0.0), (box - edge, 0.0))
        pen.wall(post, -1, low=base, high=-base, color="0.5")
        pen.arrow((box + edge, 0.0), (box + edge + 0.6 * pen.size, 0.0))
        pen.label(box + edge, 0.45 * pen.size, "$F\\,\\sin\\,\\omega t$", ha="left")
    else:
        pen.label(
            box + edge + 0.2 * pen.size, 0.0, "$a\\,\\sin\\,\\omega t$", ha="left", color=pen.green
        )
    pen.label(box, height / 2 + 0.2 * pen.size, "$e$")


def _supported(machine: Any, pen: Any, place: float) -> float:
    """Draw a body between stops, on a spring and a damper from a post; return the post's place."""
    size = pen.size
    post, back = -pen.reach - 2.6 * size, place - size / 2
    pen.floor(post, pen.reach + 1.4 * size, -0.5 * size)
    pen.wall(post, -1, low=-0.5 * size, high=0.8 * size, color="0.5")
    pen.spring((post, 0.23 * size), (back, 0.23 * size))
    pen.damper((post, -0.24 * size), (back, -0.24 * size))
    pen.body(place, width=size)
    for stop in stops_of(machine):
        pen.stop(stop, slot=0.43 * size)  # spring and damper pass through one on the left
    return post


def draw_duffing(machine: Any, pen: Any, state: State, phase: float) -> None:
    """A body on its spring, between stops, with the force on it."""
    place, size = float(state.Y), pen.size
    post = _supported(machine, pen, place)
    pull = 0.9 * size * cos(phase)
    if abs(pull) > 0.1 * size:
        pen.arrow((place, 0.75 * size), (place + pull, 0.75 * size))
    pen.label(place, 1.0 * size, "$A\\,\\cos\\,\\omega t$")
    pen.label((post + place) / 2, 0.75 * size, "$\\alpha x + \\beta x^3$")


def draw_rotor(machine: Any, pen: Any, state: State, phase: float) -> None:
    """A body on its spring, with the unbalanced rotor in it."""
    place, size = float(state.Y), pen.size
    radius = 0.34 * size
    post = _supported(machine, pen, place)
    pen.disc(place, 0.0, radius)
    heavy = place + radius * cos(phase), radius * sin(phase)
    pen.line((place, 0.0), heavy)
    pen.ball(*heavy, 0.1 * size, color=pen.red)
    pen.label(place + 0.15 * size, 0.68 * size, "$m,\\ r$", color=pen.red)
    pen.label(place + 0.68 * size, 0.0, "$M$", color=pen.blue)
    pen.label((post + place) / 2, 0.7 * size, "$k,\\ c$")
