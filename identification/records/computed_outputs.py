"""Find outputs that are no measurements: computed from other columns of the same row.

A column that stands twice in a file, or a sum of others, fits any model that copies it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .record import Record

Array = NDArray[np.float64]

EXACT = 1e-6
"""Share of an output's RMS that other columns leave, below which it was computed from them: a
measurement has noise, and a plant with inertia answers later."""
_ROWS_A_COLUMN = 4


@dataclass(frozen=True)
class ComputedOutput:
    """An output that is a linear combination of other columns in the same row, plus a constant.

    factors: of these columns by name. of_inputs: whether inputs alone give it.
    """

    name: str
    factors: Mapping[str, float]
    of_inputs: bool

    @property
    def words(self) -> str:
        """What was found, as 'output y_m is 2 u_n + constant in every row'."""
        terms = " + ".join(f"{factor:.3g} {name}" for name, factor in self.factors.items())
        return f"output {self.name} is {terms} + constant in every row"


def computed_outputs(records: Sequence[Record]) -> tuple[ComputedOutput, ...]:
    """Return the outputs of records of one plant that the inputs give, or the outputs before them.

    Outputs that never vary do not count, nor do records with few rows.
    """
    first = records[0]
    names = (*first.input_names, *first.output_names)
    parts = [np.hstack([r.v, r.y]) for r in records]
    largest = np.max([np.abs(part).max(axis=0, initial=0.0) for part in parts], axis=0)
    scale = np.where(largest > 0.0, largest, 1.0)  # squares stay finite
    stacked = np.vstack([part / scale - (part / scale).mean(axis=0) for part in parts])
    size = np.linalg.norm(stacked, axis=0)
    varies = size > EXACT * np.sqrt(len(stacked))
    if len(stacked) < _ROWS_A_COLUMN * len(names):
        return ()
    inputs = [j for j in range(len(first.input_names)) if varies[j]]
    found, before = [], list(inputs)
    for i in range(len(first.input_names), len(names)):
        if not varies[i]:
            continue
        for columns in (inputs, before):
            factors, left = _left(stacked, columns, i)
            if columns and left < EXACT:
                unit = factors * scale[i] / scale[columns]
                most = np.abs(factors).max()
                terms = {
                    names[j]: float(f)
                    for j, f, share in zip(columns, unit, np.abs(factors) / most, strict=True)
                    if share > EXACT
                }
                found.append(ComputedOutput(names[i], terms, columns is inputs))
                break
        else:
            before.append(i)
    return tuple(found)


def _left(stacked: Array, columns: Sequence[int], i: int) -> tuple[Array, float]:
    """Return the factors of columns that give column i, and the share of its RMS that is left."""
    chosen, own = stacked[:, columns], stacked[:, i]
    factors = np.asarray(np.linalg.lstsq(chosen, own, rcond=1e-12)[0], dtype=np.float64)
    return factors, float(np.linalg.norm(own - chosen @ factors) / np.linalg.norm(own))
