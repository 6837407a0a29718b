"""Test the shortlist of candidates by the records that have most to explain."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from declared_model_records import PLACES, point, record

from levid.identification.trace.linearised.gram_matrices import Linearised
from levid.identification.trace.linearised.linearise_prediction_errors import linearise
from levid.identification.trace.search import prescreening
from levid.identification.trace.search.prescreening import most_telling, shortlisted
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


def test_records_with_the_largest_errors_for_their_length_are_a_third_of_the_time() -> None:
    # Record 2 has the largest errors, record 0 more in all, but for its length less than record 1.
    records = [0] * 20 + [1] * 6 + [2] * 6 + [3] * 4
    squares = [50.0] * 20 + [60.0] * 6 + [90.0] * 6 + [0.0] * 4
    train = evidence(squares, records)
    assert most_telling(train, np.array(squares)) == [1, 2]


def test_few_blocks_tell_nothing() -> None:
    train = evidence([10.0] * 6, [0, 0, 1, 1, 2, 2])
    assert most_telling(train, np.array([10.0] * 6)) == []


class ThreeRecords:
    """Three records of one plant, the second with errors of a cubic stiffness at z."""

    def __init__(self) -> None:
        self.asked: list[tuple[int, object]] = []
        made = record("fixed", 41_000)  # ten blocks, as few as tell
        cubic = next(e for e in EFFECTS if e.identity == CUBIC)
        self.records = [made, made, made]
        self.effect = cubic

    def train(self, at, candidates=(), only=None) -> list[Linearised]:
        self.asked.append((len(candidates), only))
        chosen = range(3) if only is None else only
        found = []
        for i in chosen:
            one = linearise(at, self.records[i], list(candidates))
            if i == 1:  # as if the effect were in the errors: a multiple of its own column
                own = linearise(at, self.records[i], [(self.effect, ())]).beside[0]
                gram = one.gram.copy()
                size = 300.0  # times the column's length
                gram[:, :, -1] += size * own.cross[:, :, 0]
                gram[:, -1, :] += size * own.cross[:, :, 0]
                gram[:, -1, -1] += size**2 * own.inner[:, 0, 0]
                one = replace(one, gram=gram)
            found.append(one)
        return found


def test_only_some_records_are_asked_about_all_candidates() -> None:
    records = ThreeRecords()
    some = shortlisted(point(), CANDIDATES, records, OPTIONS)
    identities = {e.identity for e, _ in some}
    drives = {e.identity for e, _ in CANDIDATES if is_internal(e)}
    others = [c for c in CANDIDATES if not is_internal(c[0])]
    assert records.asked == [(0, None), (len(others), [1])]
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
