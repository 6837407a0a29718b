"""Test short records: they are left out if they would shorten the impulse response."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from levid.identification.identify import identify
from levid.identification.options import Options
from levid.identification.records.drop_short_records import drop_short_records
from levid.identification.records.record import Record
from levid.identification.results import ClosedLoopPoint

RATE_HZ = 200.0


def records(rows: Sequence[int], axes: Sequence[int] | None = None) -> list[Record]:
    """Return a record for each number of rows; it excites both inputs, or the one in `axes`."""
    out = []
    for number, count in enumerate(rows):
        v = np.random.default_rng(number).normal(size=(count, 2))
        if axes is not None:
            v[:, 1 - axes[number]] = 0.0
        out.append(Record(f"r{number}", 0.01, v, v, ("a", "b"), ("N", "N"), ("c", "d"), ("m", "m")))
    return out


def left_out(some: Sequence[Record], wanted_rows: int) -> list[str]:
    used, out = drop_short_records(some, wanted_rows)
    assert [r.name for r in some if r in used] == [r.name for r in used]
    assert len(used) + len(out) == len(some)
    return [r.name for r in out]


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        ([100, 1000, 1000], ["r0"]),
        ([1000, 300, 1000], []),  # an eighth of all rows
        ([1000, 100, 90, 1000], ["r1", "r2"]),
        ([200, 100, 1000, 1000], ["r1"]),  # both together are a seventh of all rows
        ([2000, 450, 1800], []),  # longer than required
        ([100] * 20, []),  # equal records: leaving one out gains nothing
        ([100, *range(101, 121)], []),
        ([100], []),
    ],
)
def test_few_short_records_are_left_out(rows, expected):
    assert left_out(records(rows), 400) == expected


def test_short_record_with_the_only_excitation_of_an_input_is_kept():
    assert left_out(records([1000, 1000, 90], [0, 1, 1]), 400) == ["r2"]
    assert left_out(records([1000, 1000, 90], [0, 0, 1]), 400) == []
    # The second shortest record is needed, so leaving out the shortest would gain nothing.
    assert left_out(records([1000, 80, 90], [0, 0, 1]), 400) == []


@pytest.fixture(scope="module")
def flown(rig) -> list[Record]:
    return rig.records([0.0], RATE_HZ, 45.0, at_rest=False)


def closed(some: list[Record], options: Options) -> ClosedLoopPoint:
    (point,) = identify(some, options).points
    assert isinstance(point, ClosedLoopPoint)
    return point


def test_short_record_does_not_shorten_the_impulse_response_in_a_loop(rig, flown):
    options = Options(lag_s=rig.LAG_S)
    short = Record(**{**flown[0].rows(0, 1200).__dict__, "name": "short"})
    alone, both = closed(flown, options), closed([*flown, short], options)
    assert both.records == alone.records
    assert both.remarks[0] == (
        "'short' is left out: its 1200 rows would shorten the impulse response of all"
    )
    assert both.remarks[1:] == alone.remarks
    np.testing.assert_array_equal(both.markov["least_squares"].g, alone.markov["least_squares"].g)
    assert both.subspace is not None
    # It is used if options.impulse_s is short enough.
    of_1_s = Options(lag_s=rig.LAG_S, impulse_s=1.0, segment_s=1.0)
    assert "short" in closed([*flown, short], of_1_s).records
