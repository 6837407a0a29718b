"""Test records for a trace from rig logs that lack fields, as logs of other rigs do."""

from __future__ import annotations

import numpy as np
import pytest
from in_memory_log import cycle_log, without

from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.identification.records.record import IdentificationError
from levid.identification.trace.records.record_from_log import TraceRecord, trace_record
from levid.log.reader import Log
from levid.log.signals import cycle_dtype

ROWS = 2000
OPTIONAL = ("coil_excitation_n", "beam_force_n", "rotor_rad", "rotor_rad_s")


def flown(sensors: int = 9) -> Log:
    """Return a log in which all fields of beam, rotor and coils change."""
    rng = np.random.default_rng(1)
    rows = np.zeros(ROWS, cycle_dtype(9, sensors))
    rows["cycle"] = np.arange(ROWS)
    rows["time_s"] = 1e-3 * np.arange(ROWS)
    for name in ("gap_m", "coil_n", "beam_m", "beam_m_s", *OPTIONAL):
        rows[name] = rng.normal(size=rows[name].shape)
    return cycle_log("01-sweep.mcap", rows)


def read(log: Log) -> TraceRecord:
    """Return the record for the shipped model."""
    return trace_record(log, load_model(shipped("models/rig.yaml")))


@pytest.mark.parametrize("name", ["time_s", "gap_m"])
def test_missing_required_field_is_named(name: str) -> None:
    with pytest.raises(IdentificationError, match=f"found no field {name}, which a trace needs"):
        read(without(flown(), name))


def test_missing_optional_fields_are_replaced_and_listed() -> None:
    whole, less = read(flown()), read(without(flown(), *OPTIONAL))
    assert whole.remarks == ()
    assert whole.drive_n is not None
    assert less.drive_n is None
    assert not less.coil_excitation.any()
    assert not less.rotor.any()
    np.testing.assert_array_equal(whole.beam, less.beam)
    assert [remark.partition(":")[0] for remark in less.remarks] == [
        "no field coil_excitation_n",
        "no field beam_force_n",
        "no field rotor_rad and rotor_rad_s",
    ]


def test_number_of_sensors_other_than_the_rigs_is_an_error() -> None:
    with pytest.raises(IdentificationError, match=r"gap_m: expected the 9 sensors .*, found 8"):
        read(flown(sensors=8))
