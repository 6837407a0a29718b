"""Test whether a position moves or hunts by one step of its encoder."""

from __future__ import annotations

import numpy as np
import pytest

from levid.identification.trace.records.record_from_log import _moves

STEP_M = 1e-8


@pytest.mark.parametrize(
    ("steps", "moves"),
    [([0, 0, 0], False), ([0, 1, 0], False), ([-1, 0, 1], False), ([0, 1, 2, 3], True)],
)
def test_hunting_by_one_step_to_either_side_is_rest(steps: list[int], moves: bool) -> None:
    position = STEP_M * np.repeat(np.array(steps, float), 500)
    assert _moves(position) is moves
