"""Forecasts of what follows a grazing, of a few of the machines of the study, beside its judge."""

from typing import Any

import numpy as np
import pytest
import vi_jax as vi
from studies.parts.grazing_machines import KINDS, machines
from studies.parts.grazing_verdict import LANES, Lanes, judged, name_of, verdict


@pytest.mark.slow
def test_forecasts_beside_simulation():
    for n, (drawn, point) in enumerate(machines(KINDS["scene"][0], 3, 7)):
        found = vi.grazing(point, progress=False)
        *_, lanes, named = judged(point, drawn.parameter, found, n)
        assert lanes.side == found.side
        assert name_of(found) == named


@pytest.mark.exhaustive
def test_windows_beside_simulation():
    """Of a prestressed stop. The motion of three cycles is there 8e-7 before the grazing already,
    9e-4 away: a jump in the limit, which lanes farther off read as the first window of period
    adding. So it is the windows that are compared, not the names."""
    ((drawn, point),) = machines(KINDS["prestressed"][0], 1, 7)
    found = vi.grazing(point, progress=False)
    *_, lanes, _ = judged(point, drawn.parameter, found, 0)
    assert found.windows is not None and lanes.side == found.side
    ends = dict(zip(found.windows.period, np.sort(found.windows.stable, axis=1), strict=True))
    assert set(lanes.period) == {2, 3}
    for offset, period in zip(found.side * lanes.offset, lanes.period, strict=True):
        low, high = ends[period]  # of the local map, whose ends are a few per cent off out there
        assert 1.1 * low < offset < 0.9 * high


def lanes_of(power, period, touches):
    offset = np.geomspace(1e-6, 1e-3, LANES)
    return Lanes(offset, offset**power, np.asarray(period), np.asarray(touches, float), 1)


def test_the_judge_tells_windows_from_each_other():
    """By made-up lanes: each name, without a machine."""
    nowhere: Any = None
    n, none = np.arange(LANES), np.zeros(LANES, int)
    falling = 8 - n // 32  # 8 … 3, longest nearest to the grazing
    assert verdict(nowhere, "", lanes_of(0.5, none + 1, none + 1), 0) == "persistence"
    assert verdict(nowhere, "", lanes_of(0.5, none, none), 0) == "chaos"
    assert verdict(nowhere, "", lanes_of(0.5, falling, none + 1), 0) == "period_adding"
    assert verdict(nowhere, "", lanes_of(0.5, falling[::-1], none + 1), 0) == "periodic"
    between = np.where(n % 4 == 0, 0, falling)
    assert verdict(nowhere, "", lanes_of(0.5, between, none + 1), 0) == "period_adding_with_chaos"
    assert verdict(nowhere, "", lanes_of(0.5, between, none + 2), 0) == "windows_and_chaos"
