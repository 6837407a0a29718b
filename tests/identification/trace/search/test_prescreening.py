"""Test the shortlist of candidates by the records that have most to explain."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from declared_model_records import PLACES, point, record

from levid.identification.trace.linearised.gram_matrices import Linearised
from levid.identification.trace.linearised.linearise_prediction_errors import linearise
from levid.identification.trace.search import prescreening
from levid.identification.trace.search.gauss_newton import Part
from levid.identification.trace.search.prescreening import (
    most_telling,
    most_telling_records,
    shortlisted,
)
from levid.identification.trace.search.tested_candidate import is_internal
from levid.identification.trace.search_options import SearchOptions
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.operating_range import Extent

OPTIONS = SearchOptions()
EFFECTS = all_effects(PLACES, Extent.typical(PLACES))
CUBIC = "rod_stiffness.cubic@z"
CANDIDATES = [
    (e, tuple(shape))
    for e in EFFECTS[:110]
    if e.effect_class in {"friction", "cogging"} or not e.shape
    for shape in (e.grid if e.where == ("z",) else e.grid[:1])
]


def evidence(squares: list[float], records: list[int]) -> SimpleNamespace:
    """Return blocks of 100 expected squared errors with these squares above them."""
    gram = np.array(squares)[:, None, None] + 100.0
    return SimpleNamespace(record=np.array(records), count=np.full(len(squares), 100.0), gram=gram)


RECORDS = [0] * 20 + [1] * 5 + [2] * 5 + [3] * 6
SQUARES = np.array(
    [5.0] * 15 + [6.0] * 5 + [0.0, 9.0, 9.0, 0.0, 0.0] + [9.0] * 2 + [8.0] * 3 + [0.0] * 6
)


def test_parts_are_of_every_record_and_as_short_as_can_be_cross_validated() -> None:
    parts = most_telling(evidence(SQUARES, RECORDS), SQUARES[None], 0.0)
    assert parts == [Part(0, 15, 17), Part(1, 1, 3), Part(2, 0, 2), Part(3, 0, 2)]


def test_parts_are_as_long_as_hold_what_is_needed() -> None:
    train, more = evidence(SQUARES, RECORDS), SQUARES.copy()
    more[3] = 30.0
    parts = most_telling(train, np.stack([SQUARES, more]), 60.0)
    assert parts[0] == Part(0, 2, 4)
    assert most_telling(train, SQUARES[None], 60.0)[0] == Part(0, 15, 17)


def test_parts_are_a_quarter_of_the_time_at_most() -> None:
    train = evidence(SQUARES, RECORDS)
    assert most_telling(train, SQUARES[None], np.inf) == most_telling(train, SQUARES[None], 0.0)


def test_records_with_the_largest_errors_for_their_length_are_a_quarter_of_the_time() -> None:
    # Record 0 has the largest errors in all, but not for its length.
    records = most_telling_records(evidence(SQUARES, RECORDS), SQUARES)
    assert records == [Part(0, 0, 20), Part(2, 0, 5)]


def test_few_blocks_tell_nothing() -> None:
    train = evidence([10.0] * 6, [0, 0, 1, 1, 2, 2])
    assert most_telling(train, np.full((1, 6), 10.0), 0.0) == []
    assert most_telling_records(train, np.full(6, 10.0)) == []


class ThreeRecords:
    """Three records of one plant, the second with errors of a cubic stiffness at z."""

    def __init__(self) -> None:
        self.asked: list[tuple[int, Any]] = []
        made = record("fixed", 49_000)  # twelve blocks: a quarter of three tells
        cubic = next(e for e in EFFECTS if e.identity == CUBIC)
        self.records = [made, made, made]
        self.effect = cubic

    def train(self, at, candidates=(), only=None) -> list[Linearised]:
        self.asked.append((len(candidates), only))
        chosen = [(i, None) for i in range(3)] if only is None else [(p[0], p[1:]) for p in only]
        found = []
        for i, blocks in chosen:
            one = linearise(at, self.records[i], list(candidates), blocks)
            if i == 1:  # as if the effect were in the errors: a multiple of its own column
                own = linearise(at, self.records[i], [(self.effect, ())], blocks).beside[0]
                gram = one.gram.copy()
                size = 300.0  # times the column's length
                gram[:, :, -1] += size * own.cross[:, :, 0]
                gram[:, -1, :] += size * own.cross[:, :, 0]
                gram[:, -1, -1] += size**2 * own.inner[:, 0, 0]
                one = replace(one, gram=gram)
            found.append(one)
        return found


def test_only_parts_of_records_are_asked_about_all_candidates() -> None:
    records = ThreeRecords()
    some = shortlisted(point(), CANDIDATES, records, OPTIONS)
    identities = {e.identity for e, _ in some}
    drives = {e.identity for e, _ in CANDIDATES if is_internal(e)}
    others = [c for c in CANDIDATES if not is_internal(c[0])]
    (none, every), (asked, parts) = records.asked
    assert (none, every, asked) == (0, None, len(others))
    assert [(p.record, p.last - p.first) for p in parts] == [(0, 3), (1, 3), (2, 3)]
    assert drives <= identities  # the errors of the platform do not tell of them
    assert len(identities - drives) <= OPTIONS.shortlisted
    assert [c for c in CANDIDATES if c in some] == some  # in their order


def test_few_candidates_are_all_returned_unasked() -> None:
    records = ThreeRecords()
    few = CANDIDATES[:5]
    assert shortlisted(point(), few, records, OPTIONS) == few
    assert records.asked == []


@pytest.mark.parametrize(("share", "several"), [(0.0, True), (1.0, False)])
def test_shapes_far_from_the_best_are_left_out(share: float, several: bool, monkeypatch) -> None:
    monkeypatch.setattr(prescreening, "_SHAPE", share)
    some = shortlisted(point(), CANDIDATES, ThreeRecords(), OPTIONS)
    rows = [e.identity for e, _ in some if e.where == ("z",)]
    assert any(rows.count(row) > 1 for row in rows) == several
