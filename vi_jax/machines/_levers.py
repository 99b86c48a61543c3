"""Coordinates that are sums of a woodpecker's height and angles, and the forces that act there."""

import dataclasses
from collections.abc import Sequence
from functools import reduce
from operator import add
from typing import Any

from .._types import Scalar
from ..machine import Coordinate

Row = tuple[Any, Any, Any]
"""By how much y, φM and φS each enter: a number, or `None` where one does not."""

Inertia = tuple[Sequence[Any], Sequence[Any], Any]
"""The diagonal D of a matrix of masses D + m a aᵀ; D⁻¹a; and 1/m + aᵀD⁻¹a."""


def dot(row: Sequence[Any], values: Sequence[Any]) -> Any:
    """The sum of these values times the numbers of a row, where 1 and -1 are no work."""
    terms = [
        (x if a > 0 else -x) if isinstance(a, int) else a * x
        for a, x in zip(row, values, strict=True)
        if a is not None
    ]
    return reduce(add, terms)


def response(row: Row, inertia: Inertia) -> list[Any]:
    """The accelerations of y, φM and φS by a force of one along a row: the inverse of Sherman and
    Morrison, D⁻¹ - D⁻¹a aᵀD⁻¹/(1/m + aᵀD⁻¹a), times that row."""
    own, by, total = inertia
    common = dot(row, by) / total
    return [
        -x * common if a is None else a / m - x * common
        for a, m, x in zip(row, own, by, strict=True)
    ]


def by_levers(row: Row, inertia: Inertia) -> Coordinate:
    """The sum of y, φM and φS times the numbers of a row. One of an angle alone is set, to the last
    bit; one with y is placed by the height."""
    gained = response(row, inertia)
    mobility = dot(row, gained)

    def position(x: Any) -> Scalar:
        return dot(row, (x.height, x.sleeve_angle, x.bird_angle))

    def velocity(x: Any) -> Scalar:
        return dot(row, (x.speed, x.sleeve_rate, x.bird_rate))

    def placed(x: Any, Y: Scalar, V: Scalar) -> Any:
        impulse = (V - velocity(x)) / mobility
        if row[0] is not None:
            place = {"height": x.height + Y - position(x)}
        elif row[1] is not None:
            place = {"sleeve_angle": Y / row[1]}
        else:
            place = {"bird_angle": Y / row[2]}
        rates = {
            name: getattr(x, name) + impulse * a
            for name, a in zip(("speed", "sleeve_rate", "bird_rate"), gained, strict=True)
        }
        return dataclasses.replace(x, **place, **rates)

    return Coordinate(position, velocity, placed, 1 / mobility)
