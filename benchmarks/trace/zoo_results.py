"""Results of the zoo: kept as lines of JSON, one a plant, and published as one file of them."""

from __future__ import annotations

import gzip
import hashlib
import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from levid.benchmarks.trace.zoo_cases import wherever
from levid.benchmarks.trace.zoo_fly import canonical, code_version
from levid.benchmarks.trace.zoo_plan import Plant, plant_named
from levid.benchmarks.trace.zoo_sizes import Sizes

_NOT_FLOWN = "not flown"


@dataclass(frozen=True)
class Result:
    """What came of a plant: _zoo_fly.Found as plain data, or why there is none.

    `entries` are the effects that were flown: `less` of each where the plant's own could not be.
    `wall_s` is None where nobody looked at the clock, `floor_m` (rms of a plant that holds nothing)
    where that was not flown. `seed` is the one it was flown with, None where nobody noted it.
    """

    plant: Plant
    found: dict[str, Any] | None
    failed: str = ""
    entries: tuple[dict[str, Any], ...] = ()
    less: bool = False
    wall_s: float | None = None
    floor_m: float | None = None
    seed: int | None = None

    @property
    def flown(self) -> bool:
        """Whether it was tried at all."""
        return self.found is not None or self.failed != _NOT_FLOWN

    @property
    def floor(self) -> float | None:
        """The floor of a plant that holds nothing, in the unit of the errors of this result."""
        sd_m = None if self.found is None else self.found.get("sensor_sd_m")
        return None if sd_m is None or self.floor_m is None else self.floor_m / sd_m

    @property
    def seconds(self) -> float:
        """Seconds of processor time that flight and trace took, 0 of one that failed."""
        return 0.0 if self.found is None else self.found["flight_s"] + self.found["trace_s"]


class Kept:
    """The results in a folder, by plant, sizes, seed and version of the code.

    With them, if given, those of a compressed file that others published.
    """

    def __init__(self, folder: Path, published: Path | None = None) -> None:
        self._file = folder / "results.jsonl"
        self.version = code_version()
        lines = [] if published is None else _published(published)
        if self._file.exists():
            lines += self._file.read_text(encoding="utf-8").splitlines()
        self._rows = _by_key(lines)

    @property
    def codes(self) -> dict[str, int]:
        """How many results there are of each version of the code."""
        return dict(Counter(row["code"] for row in self._rows.values()))

    def has(self, plant: Plant, sizes: Mapping[str, Sizes]) -> bool:
        """Return whether there is a result; one that failed is none."""
        row = self._rows.get(self._key(plant, sizes))
        return row is not None and row["found"] is not None

    def add(self, result: Result, sizes: Mapping[str, Sizes]) -> None:
        """Keep a result, at once."""
        key = self._key(result.plant, sizes)
        row = {
            "key": key,
            "plant": result.plant.name,
            "code": self.version,
            "effects": list(result.entries),
            "less": result.less,
            "wall_s": result.wall_s,
            "seed": result.seed,
            "failed": result.failed,
            "found": result.found,
        }
        self._rows[key] = row
        self._file.parent.mkdir(parents=True, exist_ok=True)
        with self._file.open("ab+") as file:
            if file.tell() and (file.seek(-1, os.SEEK_END), file.read(1))[1] != b"\n":
                file.write(b"\n")  # after a line that was cut off
            file.write(json.dumps(row).encode() + b"\n")

    def publish(self, file: Path) -> int:
        """Write the results of this code, and of no other, compressed; return how many.

        Those of this code that are in the file stay, but for plants that there is a result of here.
        The same results make the same bytes, wherever the files of effects lie.
        """
        every = {**_by_key(_published(file)), **{k: r for k, r in self._rows.items() if r["found"]}}
        rows = [
            {**row, "effects": [wherever(entry) for entry in row["effects"]]}
            for row in every.values()
            if row["code"] == self.version and row["found"]
        ]
        rows.sort(key=lambda row: (row["plant"], row["key"]))
        text = "".join(json.dumps(row) + "\n" for row in rows)
        file.write_bytes(gzip.compress(text.encode(), mtime=0))
        return len(rows)

    def of(
        self,
        plants: Sequence[Plant],
        sizes: Mapping[str, Sizes],
        floor_m: float | None = None,
    ) -> list[Result]:
        """Return the results of plants, in their order; those that there are none of fail."""
        rows = ((plant, self._rows.get(self._key(plant, sizes))) for plant in plants)
        return [
            Result(plant, None, _NOT_FLOWN) if row is None else _result(plant, row, sizes, floor_m)
            for plant, row in rows
        ]

    def all(
        self, code: str, sizes: Mapping[str, Sizes], floor_m: float | None = None
    ) -> list[Result]:
        """Return all results of a version of the code, whatever they were flown for.

        Of a plant that was sized anew the last one counts.
        """
        found = {}
        for row in self._rows.values():
            plant = plant_named(row["plant"]) if row["code"] == code else None
            if plant is not None:
                found[plant.name] = _result(plant, row, sizes, floor_m)
        return list(found.values())

    def _key(self, plant: Plant, sizes: Mapping[str, Sizes]) -> str:
        entries = [wherever(entry) for entry in plant.entries(sizes)]
        text = canonical([entries, plant.seed, self.version])
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def _result(
    plant: Plant, row: Mapping[str, Any], sizes: Mapping[str, Sizes], floor_m: float | None
) -> Result:
    entries = tuple(row["effects"])
    less = row.get("less")
    if less is None:  # nobody noted it: its values tell, wherever its file lies
        asked = plant.entries(sizes) if all(c.name in sizes for c in plant.cases) else entries
        less = [_values(entry) for entry in entries] != [_values(entry) for entry in asked]
    wall_s, seed = row.get("wall_s"), row.get("seed")
    return Result(plant, row["found"], row["failed"], entries, less, wall_s, floor_m, seed)


def _values(entry: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in entry.items() if key != "use"}


def _published(file: Path) -> list[str]:
    return gzip.decompress(file.read_bytes()).decode().splitlines() if file.exists() else []


def _by_key(lines: Sequence[str]) -> dict[str, dict[str, Any]]:
    rows = [row for row in map(_row, lines) if row is not None]
    # One that failed does not take the place of one that did not.
    rows.sort(key=lambda row: row["found"] is not None)
    return {row["key"]: row for row in rows}


def _row(line: str) -> dict[str, Any] | None:
    """Return a line's result; None for one that was cut off when the run was stopped."""
    try:
        row: dict[str, Any] = json.loads(line)
    except ValueError:
        return None
    return row
