"""Say why records cannot give a model, whatever the model is: no excitation, or no measurement."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from threadpoolctl import threadpool_limits

from ..records.computed_outputs import computed_outputs
from ..records.record import Record
from .feedback_test import (
    FeedbackFindings,
    InputOrigin,
    feedback_findings,
    input_origins,
)


def findings_of_records(
    records: Sequence[Record],
) -> tuple[tuple[InputOrigin, ...], FeedbackFindings]:
    """Return where the inputs of records of one plant and rate come from, and what follows."""
    origins = input_origins(records)
    found = feedback_findings(origins, records[0].feedback)
    copies = [output.words for output in computed_outputs(records) if output.of_inputs]
    if not copies:
        return origins, found
    why = (
        f"{'; '.join(copies)}, to one part in a million: no plant is measured so exactly. Either "
        "a column stands twice, or a controller computes an input from outputs, and next to "
        "nothing else moves it. Check the columns; excite a loop, and declare it in the signals "
        "file (key loop)"
    )
    return origins, FeedbackFindings((why,), found.remarks, (why,))


def why_no_model(records: Sequence[Record]) -> tuple[str, ...]:
    """Return why no model of records without a known controller can be recommended.

    The records may be of several rates, which a black-box model cannot be; the first rate with a
    reason gives it.
    """
    with threadpool_limits(1):
        for same in _alike(records):
            try:
                found = findings_of_records(same)[1].of_any
            except np.linalg.LinAlgError:
                continue
            if found:
                return found
    return ()


def _alike(records: Sequence[Record]) -> list[list[Record]]:
    groups: dict[tuple[object, ...], list[Record]] = {}
    for r in records:
        if r.controller is None:
            groups.setdefault((r.Ts_s, r.input_names, r.output_names), []).append(r)
    return list(groups.values())
