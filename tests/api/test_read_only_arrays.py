"""Arrays that the Python API gives away are read-only: a record keeps them for later results."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel

import levid


def _arrays(value: object, name: str, seen: set[int], depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Yield all arrays in public attributes of objects of levid, and in what these hold."""
    if id(value) in seen or depth > 12:
        return
    seen.add(id(value))
    if isinstance(value, np.ndarray):
        yield name, value
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _arrays(inner, f"{name}[{key!r}]", seen, depth + 1)
    elif isinstance(value, Sequence) and not isinstance(value, (str, bytes)):
        for number, inner in enumerate(value):
            yield from _arrays(inner, f"{name}[{number}]", seen, depth + 1)
    if type(value).__module__.startswith("levid.") and not isinstance(value, BaseModel):
        # What is computed at each access is nobody's cache: only what the numerics hold counts.
        ours = type(value).__module__.startswith("levid.api.")
        held = dir(value) if ours else vars(value) if hasattr(value, "__dict__") else ()
        for attribute in (a for a in held if not a.startswith("_")):
            inner = getattr(value, attribute, None)
            if not callable(inner):
                yield from _arrays(inner, f"{name}.{attribute}", seen, depth + 1)


def test_public_arrays_are_read_only(imported: levid.Session, flown: Any) -> None:
    found = imported.identify(order=2, warn=lambda _: None)
    assert found.results.grey is not None  # so that the fitted model's arrays are among them
    record = levid.load(flown).records[0]
    objects = {"session": imported, "record": record, "found": found, "plant": found.plant()}
    arrays = [a for name, value in objects.items() for a in _arrays(value, name, set())]
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
