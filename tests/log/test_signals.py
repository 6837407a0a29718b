"""Test the signal table and the conversion between dtype and schema text."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from mcap_ros2._dynamic import generate_dynamic

from levid.log.cycle_codes import Fault, State
from levid.log.errors import LogError
from levid.log.signals import SIGNALS, cycle_dtype, dtype_from_ros2msg, ros2msg

# The name of a signal ends with its unit; the longest ending counts (`beam_m_s2`: m/s2, not s2).
UNIT_ENDINGS = {
    "_n_m": "N m",
    "_rad_s": "rad/s",
    "_m_s2": "m/s2",
    "_m_s": "m/s",
    "_rad": "rad",
    "_n": "N",
    "_m": "m",
    "_s": "s",
}


@pytest.mark.parametrize("signal", SIGNALS, ids=lambda s: s.name)
def test_signal_name_ends_with_its_unit(signal):
    endings = [e for e in UNIT_ENDINGS if signal.name.endswith(e)]
    expected = UNIT_ENDINGS[max(endings, key=len)] if endings else "1"
    assert signal.unit == expected, f"a new unit needs an ending in UNIT_ENDINGS of {__file__}"


@pytest.mark.parametrize(("coils", "sensors"), [(9, 9), (4, 4), (3, 7), (16, 5), (1, 1)])
def test_cycle_dtype_has_no_padding_and_round_trips_through_the_schema(coils, sensors):
    dtype = cycle_dtype(coils, sensors)
    assert dtype.itemsize == sum(dtype[name].itemsize for name in dtype.names)
    assert dtype["coil_n"].shape == (coils,)
    assert dtype["gap_m"].shape == (sensors,)
    assert dtype_from_ros2msg(ros2msg(dtype)) == dtype


def test_schema_has_unit_and_description_of_every_field():
    lines = [line for line in ros2msg(cycle_dtype(9, 9)).splitlines() if "=" not in line.split()[1]]
    assert len(lines) == len(SIGNALS)
    for line, signal in zip(lines, SIGNALS, strict=True):
        assert line.endswith(f"  # [{signal.unit}] {signal.description}")


def test_names_of_codes_are_constants_directly_before_their_field():
    text = ros2msg(cycle_dtype(9, 9))
    lines = text.splitlines()
    for field, codes in (("state", State), ("fault", Fault)):
        at = next(k for k, line in enumerate(lines) if line.startswith(f"uint8 {field} "))
        expected = [f"uint8 {field.upper()}_{code.name}={code.value}" for code in codes]
        assert lines[at - len(expected) : at] == expected
    independent = generate_dynamic("levid/msg/Cycle", text)["levid/msg/Cycle"]
    assert independent is not None
    assert "STATE_LEVITATING=2" in text


def test_schema_of_other_fields_uses_their_units():
    dtype = np.dtype([("u_v", "<f8"), ("n", "u1")])
    assert ros2msg(dtype, {"u_v": "V"}) == "float64 u_v  # [V]\nuint8 n\n"


@pytest.mark.parametrize(
    ("dtype", "expected_error"),
    [
        (np.dtype([("Gap", "<f4")]), "Gap"),
        (np.dtype([("a__b", "<f4")]), "a__b"),
        (np.dtype([("a", "S4")]), "'a'"),
        (np.dtype([("a", "<f2")]), "float16"),
        (np.dtype([("a", "<f4", (2, 2))]), r"\(2, 2\)"),
        (np.dtype([("a", ">f4")]), "little-endian"),
        (np.dtype([("a", "u1"), ("b", "<f8")]), "falling size"),
        (np.dtype("<f8"), "named fields"),
    ],
)
def test_dtype_without_a_schema_is_rejected(dtype, expected_error):
    with pytest.raises(LogError, match=expected_error):
        ros2msg(dtype)


def test_cdr_offsets_of_a_foreign_schema_agree_with_an_independent_decoder():
    text = """
# a file-level comment
uint8 MODE_FAST=1   # a constant is no field
string NAME="a = b"
bool on
float64 force   # [N]
int16[3] counts [1, 2, 3]
float32 gain 2.5
byte[2] raw
uint64 stamp
char letter
================================================================================
MSG: other/Thing
string never_looked_at
"""
    dtype = dtype_from_ros2msg(text)
    assert dtype.names == ("on", "force", "counts", "gain", "raw", "stamp", "letter")
    row = np.zeros(1, dtype)
    row["on"], row["force"], row["counts"] = True, -1.25, [1, -2, 3]
    row["gain"], row["raw"], row["stamp"], row["letter"] = 0.5, [7, 8], 2**63, 65
    decode = generate_dynamic("x/msg/Y", text)["x/msg/Y"]
    message = decode(b"\0\1\0\0" + row.tobytes())
    assert (message.on, message.force, message.counts) == (True, -1.25, [1, -2, 3])
    assert (message.gain, message.raw, message.stamp) == (0.5, b"\7\10", 2**63)
    assert message.letter == 65
    # Bytes 0, 8 to 16, 16 to 22, 24 to 28, 28 to 30, 32 to 40, 40.
    packed = struct.pack("<?7xd3h2xf2B2xQB", True, -1.25, 1, -2, 3, 0.5, 7, 8, 2**63, 65)
    assert row.tobytes() == packed


@pytest.mark.parametrize(
    ("text", "expected_error"),
    [
        ("float64[] x", "'x'.*float64.* no fixed size"),
        ("float64[<=3] x", "'x'.*no fixed size"),
        ("string name", "'name'.*no fixed size"),
        ("string<=10 name", "'name'.*no fixed size"),
        ("std_msgs/Header header", "'header'.*nested.*std_msgs/Header"),
        ("float64 x\nfloat64 x", "found 'x' twice"),
        ("float64[0] x", "'x'"),
        ("float64[99999999] x", "'x'.*grows beyond"),
        ("float64[999999999999] x", "'x'"),
        ("float64", "type name"),
        ("", "found none"),
        ("\0\1\2", "type name"),
    ],
)
def test_schema_without_fixed_size_is_rejected_with_the_field(text, expected_error):
    with pytest.raises(LogError, match=expected_error):
        dtype_from_ros2msg(text)
