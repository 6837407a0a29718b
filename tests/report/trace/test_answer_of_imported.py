"""Test the sentence on the missing force of imported records."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from levid.identification.trace.force_trace.model_check import ModelCheck
from levid.identification.trace.search_options import SearchOptions
from levid.report.trace.answer import _rest_of_imported


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ((20.0,), (0.5,), "falls from 20 to 0.5 % of the inputs' force."),
        (
            (0.12, 83.9), (0.1195, 0.213),
            "falls from 83.9 to 0.213 % of the inputs' force at b and stays 0.119 % at a.",
        ),
        (
            (13.8, 47.0), (14.2, 33.0),
            "falls from 47 to 33 % of the inputs' force at b and rises from 13.8 to 14.2 % at a.",
        ),
        ((9.7,), (9.69,), "stays 9.69 % of the inputs' force."),
        ((5.0,), (6.0,), "does not fall: from 5 to 6 % of the inputs' force."),
    ],
)  # fmt: skip
def test_the_missing_force_of_each_dof_falls_stays_or_rises(
    before: tuple[float, ...], after: tuple[float, ...], said: str
) -> None:
    result = SimpleNamespace(
        dof=("a", "b")[: len(before)],
        before=SimpleNamespace(force_percent=before),
        after=SimpleNamespace(force_percent=after),
        laws=("a law",),
        lacks=(),
        form_matters={},
        at_turns=(),
        check=ModelCheck(SearchOptions()),
        beyond_noise={},
    )
    assert _rest_of_imported(result) == f"The missing force {said}"  # type: ignore[arg-type]


def test_what_is_more_than_noise_is_said_where_no_form_describes_it() -> None:
    result = SimpleNamespace(
        dof=("a", "b"),
        before=SimpleNamespace(force_percent=(75.9, 3.0)),
        after=SimpleNamespace(force_percent=(18.7, 3.0), noise_percent=(0.039, 2.9)),
        laws=("a law",),
        lacks=(),
        form_matters={},
        at_turns=(),
        check=ModelCheck(SearchOptions()),
        beyond_noise={"a": 1.0},
    )
    assert _rest_of_imported(result).endswith(  # type: ignore[arg-type]
        "The model lacks something else: the noise of the outputs explains 0.039 % at a only."
    )


def test_what_a_free_form_describes_and_no_law_does_is_said() -> None:
    result = SimpleNamespace(
        dof=("a",),
        before=SimpleNamespace(force_percent=(87.4,)),
        after=SimpleNamespace(force_percent=(87.4,), noise_percent=np.array([3.1])),
        with_form=[("a", 85.0, 3.21)],
        laws=(),
        lacks=(),
        form_matters={"a": 0.99},
        at_turns=(),
        check=ModelCheck(SearchOptions()),
    )
    assert _rest_of_imported(result).endswith(  # type: ignore[arg-type]
        "The model lacks something: in the fitted rows it leaves 85 % of the force, with a free "
        "form of all signals 3.21 %."
    )


def test_what_is_left_at_turns_is_no_other_law() -> None:
    result = SimpleNamespace(
        dof=("a",),
        before=SimpleNamespace(force_percent=(25.2,)),
        after=SimpleNamespace(force_percent=(2.73,)),
        laws=("friction",),
        lacks=(),
        form_matters={},
        beyond_noise={},
        at_turns=("a",),
        check=ModelCheck(SearchOptions()),
    )
    said = _rest_of_imported(result)  # type: ignore[arg-type]
    assert said.endswith(
        "What is left at a is left at the turns, where friction may hold it for a moment."
    )
    assert "lacks" not in said
