"""Test which signals of a record change."""

from __future__ import annotations

import numpy as np

from levid.identification.records.varying_signals import varying


def test_columns_that_differ_anywhere_vary() -> None:
    x = np.zeros((5000, 4))
    x[3, 1], x[4321, 2], x[1, 3] = 1e-300, 1.0, np.nan
    assert varying(x).tolist() == [False, True, True, True]


def test_a_record_of_one_row_varies_nowhere() -> None:
    assert varying(np.ones((1, 2))).tolist() == [False, False]
