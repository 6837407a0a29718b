"""Arrays that the Python API gives away are read-only: a record keeps them for later results."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from arrays_of_results import arrays_of

import levid


def test_public_arrays_are_read_only(imported: levid.Session, flown: Any) -> None:
    found = imported.identify(order=2, warn=lambda _: None)
    assert found.results.grey is not None  # so that the fitted model's arrays are among them
    record = levid.load(flown).records[0]
    objects = {"session": imported, "record": record, "found": found, "plant": found.plant()}
    arrays = [a for name, value in objects.items() for a in arrays_of(value, name)]
    names = {name for name, _ in arrays}
    assert {"record.time_s", "plant.A"} <= names
    assert "found.results.grey.fit.covariance" in names
    assert [name for name, array in arrays if array.flags.writeable] == []
    for column in ("time_s", "gap_m", "gap_m_3"):
        with pytest.raises(ValueError, match="read-only"):
            record[column][0] = 0.0


def test_tables_are_copies(flown: Any) -> None:
    record = levid.load(flown).records[0]
    before = record["z_m"].copy()
    frame = record.to_pandas()
    frame["z_m"] += 1.0
    frame.loc[frame.index[0], "z_m"] = 5.0
    dataset = record.to_xarray()
    dataset["z_m"][0] = 5.0
    assert np.array_equal(record["z_m"], before)
