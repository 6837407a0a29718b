"""Test which rows are held out, and what the excitation is called."""

from __future__ import annotations

import numpy as np
import pytest

from levid.benchmarks.harness.loops_under_noise import Loop, multisine, steps
from levid.identification.records.excitation_kind import excitations
from levid.identification.records.held_out_rows import held_out_rows
from levid.identification.records.record import Record

ROWS = 2000
ONE_STEP = (np.arange(ROWS) > 300).astype(float)


def record(u: np.ndarray) -> Record:
    return Loop(force=0.0).record(len(u), 1, given=u)


@pytest.mark.parametrize(
    "u", [np.random.default_rng(1).normal(size=ROWS), multisine(ROWS, 60, 1), steps(ROWS, 100, 1)]
)
def test_last_quarter_is_held_out_of_a_record_that_moves_to_its_end(u: np.ndarray) -> None:
    r = record(u)
    held = held_out_rows(r.y, r.v, 0.25)
    assert (held.start, held.stop) == (1500, ROWS)
    assert held.remark is None


@pytest.mark.parametrize("at", [100, 300, 1000, 1700, 1900])
def test_end_of_the_only_event_is_held_out_where_the_output_moves(at: int) -> None:
    r = record((np.arange(ROWS) > at).astype(float))
    held = held_out_rows(r.y, r.v, 0.25)
    assert at < held.start < held.stop <= ROWS
    moved = r.y[held.start : held.stop, 0].std()
    assert moved > 10.0 * 1e-4  # the noise
    assert held.remark is not None
    assert "no input changes" in held.remark


def test_several_steps_with_rest_at_the_end_hold_out_the_last_one() -> None:
    u = np.zeros(ROWS)
    for k, at in enumerate((100, 400, 700, 1000)):
        u[at:] = k + 1.0
    r = record(u)
    held = held_out_rows(r.y, r.v, 0.25)
    assert 700 <= held.start <= 1010
    assert held.moves


def test_output_that_rests_cannot_validate() -> None:
    r = record(np.zeros(ROWS))
    held = held_out_rows(0.0 * r.y, r.v, 0.25)
    assert held.start == 1500
    assert not held.moves
    assert held.remark is not None


@pytest.mark.parametrize(
    ("kind", "u"),
    [
        ("steps", ONE_STEP),
        ("steps", steps(ROWS, 200, 1)),
        ("transient", ONE_STEP + 1e-3 * np.random.default_rng(2).normal(size=ROWS)),
        ("transient", np.arange(ROWS) / 100.0),
        ("transient", np.sin(np.pi * np.clip((np.arange(ROWS) - 500) / 300.0, 0.0, 1.0))),
        ("periodic", np.sin(0.1 * np.arange(ROWS))),
        ("periodic", np.tile(multisine(500, 5, 1), 4)),
        ("broadband", np.random.default_rng(3).normal(size=ROWS)),
        ("broadband", steps(ROWS, 10, 1)),
        ("constant", np.ones(ROWS)),
    ],
)
def test_excitation_is_called_by_its_kind(kind: str, u: np.ndarray) -> None:
    assert excitations([record(u)])[0].kind == kind
