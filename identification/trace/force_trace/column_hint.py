"""Prepare the force balance of imported records, and check whether their columns are as declared.

`levid trace` searches effects in this balance; `levid identify` only asks whether exchanged
columns, another sign or another unit explain what the declared model misses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from ....config.model import ModelConfig
from ....model.declared_model import DeclaredModel
from ....model.effects.effect_serialization import placed_effects
from ....model.effects.operating_range import Extent
from ...greybox.declared_model_from_config import declared_model
from ...greybox.experiment.intersample_input import Hold
from ...greybox.force_balance.band_limited_signals import (
    SHORTEST_ROWS,
    acceleration_limit,
    middle_limit,
    velocity_limit,
)
from ...greybox.free_parameters import free_parameters
from ...records.record import IdentificationError
from ..force_balance.force_record import ForceModel, ForceRecord, force_records
from ..force_balance.outputs_at_rest import with_outputs_at_rest
from ..force_balance.reported_errors import output_noise
from ..force_checks.columns_in_another_unit import explaining_unit
from ..force_checks.exchanged_columns import Exchange, explaining_exchange
from ..force_regression.training_records import Training, missing_share
from ..force_search.weighed_records import unweighed
from ..records.coil_load_history import in_one_session
from ..records.initial_guesses import extent
from ..records.read_records import read_records
from ..records.record_from_log import TraceRecord
from ..search_options import SearchOptions

Array = NDArray[np.float64]

_ROWS_PER_BLOCK = 2
"""Independent values of a block, at least: one has no error beside what it fits."""


@dataclass(frozen=True)
class RecordBalance:
    """Imported records, ready for a balance of forces below a limit.

    records: with outputs at rest set still; begins: the first row of each that only reports; train:
    the rows before; fitted: these below `limit_hz`, where laws bend motion from below `law_hz` of
    each. sd (n,): noise of the outputs. notes: outputs at rest.
    """

    records: Sequence[TraceRecord]
    model: DeclaredModel
    hold: Hold
    options: SearchOptions
    sd: Array
    limit_hz: float
    law_hz: Sequence[float]
    begins: Sequence[int]
    train: Sequence[TraceRecord]
    fitted: tuple[ForceRecord, ...]
    notes: tuple[str, ...]


def balance_of_records(
    records: Sequence[TraceRecord], config: ModelConfig, options: SearchOptions
) -> RecordBalance:
    """Return the balance of records; raises IdentificationError for records that are too short."""
    _require_rows(records, options)
    records, hold, model = in_one_session(records), config.input, declared_model(config)
    sd = output_noise(records)
    records, at_rest = with_outputs_at_rest(records, sd)
    limit_hz = min(
        middle_limit([r.experiment for r in records], hold),
        *(acceleration_limit(r.experiment, sd) for r in records),
    )
    options = replace(options, blocks=_blocks(records, limit_hz, options))
    begins = [round((1.0 - options.reported) * r.rows) for r in records]
    train = [r.cut(0, at) for r, at in zip(records, begins, strict=True)]
    # A law bends motion from above the limit into the band. A loud record shows more of it.
    law_hz = [max(limit_hz, velocity_limit(r.experiment, sd)) for r in records]
    fitted = force_records(train, hold, limit_hz, law_hz, sd)
    return RecordBalance(
        records, model, hold, options, sd, limit_hz, law_hz, begins, train, fitted, tuple(at_rest)
    )


def declared_start(balance: RecordBalance, config: ModelConfig, covered: Extent) -> ForceModel:
    """Return the model with the values of its file, and with its effects."""
    placed = placed_effects(config.effects, balance.records[0].places, covered)
    return ForceModel(balance.model, free_parameters(config), placed)


def explaining_columns(
    balance: RecordBalance,
    start: ForceModel,
    declared: ForceModel,
    found: ForceModel,
    training: Training,
) -> Exchange | None:
    """Return what columns have to be for a model without effects to explain as much.

    start: the model as its file declares it; declared, found: fitted, without and with effects.
    """
    limit_hz, options = balance.limit_hz, balance.options
    if balance.notes:  # an output at rest could stand in any place
        return None

    def missing(records: Sequence[TraceRecord], sd: Array) -> Array:
        below = force_records(records, balance.hold, limit_hz, balance.law_hz, sd)
        refitted, fit, _ = unweighed(start, below, limit_hz, options)
        return missing_share(refitted.plain.at(fit))

    before, after = (missing_share(training.plain.at(p)) for p in (declared, found))
    exchange = explaining_exchange(balance.train, balance.sd, missing, before, after, options)
    return exchange or explaining_unit(start, declared, found, training, options)


def column_hint(logs: Sequence[Path], config: ModelConfig) -> Exchange | None:
    """Return what columns of imported logs have to be for their declared model to explain them.

    None if nothing of the kind explains nearly all of the force that the fitted model misses.
    Raises IdentificationError for records that are too short or too quiet to tell.
    """
    with threadpool_limits(1):
        records = list(read_records(logs, config, 0.0)[0].values())
        balance = balance_of_records(records, config, SearchOptions())
        start = declared_start(balance, config, extent(balance.train))
        training, declared, _ = unweighed(start, balance.fitted, balance.limit_hz, balance.options)
        return explaining_columns(balance, start, declared, declared, training)


def _require_rows(records: Sequence[TraceRecord], options: SearchOptions) -> None:
    least = round(SHORTEST_ROWS / options.reported)
    for record in records:
        if record.rows < least:
            raise IdentificationError(
                f"record '{record.name}': expected at least {least} rows, of which the last "
                f"{options.reported:.0%} only report, found {record.rows}"
            )


def _blocks(records: Sequence[TraceRecord], limit_hz: float, options: SearchOptions) -> int:
    """Return the number of blocks of time: fewer for records with few independent values.

    Raises IdentificationError without a varying input, or with too little above the noise.
    """
    names = records[0].places.actuators
    still = np.all([np.ptp(r.coil, axis=0) == 0.0 for r in records], axis=0)
    if np.all(still):
        raise IdentificationError(
            f"expected an input that varies, found {', '.join(names)} constant in every row: a "
            "force that the model lacks is measured by the inputs' force"
        )
    seconds = (1.0 - options.reported) * sum(r.rows * r.experiment.Ts_s for r in records)
    independent = 2.0 * seconds * limit_hz
    least = _ROWS_PER_BLOCK * options.fewest_blocks
    if independent < least:
        raise IdentificationError(
            f"expected at least {least} independent values to fit ({_ROWS_PER_BLOCK} in each of "
            f"{options.fewest_blocks} blocks of time), found {independent:.0f}: {seconds:.3g} s "
            f"below {limit_hz:.3g} Hz, where every output is ten times above its noise. Record "
            "longer, excite more, or filter less"
        )
    return min(options.blocks, int(independent / _ROWS_PER_BLOCK))
