"""Arrays of every kind are read if they are numbers, and refused with a remedy if they are not."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from levid.log.errors import LogError
from levid.log.importing.array_variables import list_variables, read_variables
from levid.log.importing.signals_yaml import SignalsFile

pytestmark = pytest.mark.usefixtures("mat_in_this_process")

Y = np.linspace(0.0, 1.0, 30)


def read(value, name="y", role="other"):
    column = {"column": name, "name": "y", "unit": "s", "role": role}
    signals = SignalsFile.model_validate({"levid": "signals", "rate_hz": 1, "columns": [column]})
    (found,) = read_variables("data", signals, {"y": value})
    return found


@pytest.mark.parametrize(
    "value",
    [
        scipy.sparse.csc_matrix(Y[:, None]),
        Y.astype(object),
        Y[:, None].astype(object),
        Y.astype(">f4"),
        (100 * Y).astype(np.int16) / 100,
    ],
)
def test_numbers_in_other_containers_are_read(value):
    np.testing.assert_allclose(read(value), Y, atol=0.01)


def test_fields_of_a_structured_array_are_read_and_listed():
    table = np.zeros(30, [("t", float), ("pos", float)])
    table["pos"] = Y
    np.testing.assert_array_equal(read(table, "y.pos"), Y)
    assert [v.path for v in list_variables({"y": table})] == ["y.t", "y.pos"]
    with pytest.raises(LogError, match=r"a structured array; give one of its fields: y\.t, y\.pos"):
        read(table)


def test_dates_and_durations_of_numpy_are_times():
    when = np.datetime64("2024-05-01T10:00:00") + (1000 * np.arange(30)).astype("timedelta64[us]")
    np.testing.assert_allclose(read(when, role="time"), np.arange(30) * 1e-3, atol=1e-12)
    np.testing.assert_allclose(read(when - when[0], role="time"), np.arange(30) * 1e-3, atol=1e-12)
    with pytest.raises(LogError, match="found dates; dates and durations are read with role time"):
        read(when)


@pytest.mark.parametrize(
    ("value", "expected_error"),
    [
        (Y + 1j, r"complex numbers; save its parts, such as real\(y\)"),
        (np.array([Y, Y[:3]], object), r"cell array or objects; of a cell array, .*cell2mat\(y\)"),
        (np.array(["a", "b"]), "found text"),
        (np.array([{}]), "cell array or objects"),
    ],
)
def test_other_contents_are_refused_with_a_remedy(value, expected_error):
    with pytest.raises(LogError, match=expected_error):
        read(value)
