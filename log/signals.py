"""Define the signals of a cycle in one table that gives dtype, ros2msg schema and docs."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Literal

import numpy as np

from .cycle_codes import Fault, State
from .errors import LogError

Shape = Literal["scalar", "coil", "sensor"]
Codes = type[IntEnum]


@dataclass(frozen=True)
class Signal:
    """One field of the cycle record: one value per cycle, or one per coil or sensor."""

    name: str
    unit: str
    type: str
    shape: Shape
    description: str
    codes: Codes | None = None
    """Names of the values, written as constants before the field: viewers show them."""


class Stale(IntFlag):
    """Bits of the field `stale`: the devices whose values were repeated from an earlier cycle.

    SETPOINTS: the amplifiers report that no setpoints arrived, so the force is an earlier cycle's.
    """

    SENSORS = 1
    AMPLIFIERS = 2
    DRIVES = 4
    SETPOINTS = 8


# Fields of 8 bytes first, then 4, then 1: CDR then needs no padding for any number of coils and
# sensors, and the packed little-endian numpy record is the message's payload.
SIGNALS: tuple[Signal, ...] = (
    Signal("cycle", "1", "uint64", "scalar", "number of the cycle, skipped periods counted"),
    Signal("time_s", "s", "float64", "scalar", "time, runs on through the files of a session"),
    Signal("gap_m", "m", "float32", "sensor", "height above the working point, as measured"),
    Signal("psi_rad", "rad", "float32", "scalar", "pose q = T gap: tilt that lifts +y"),
    Signal("theta_rad", "rad", "float32", "scalar", "pose q = T gap: tilt that lifts +x"),
    Signal("z_m", "m", "float32", "scalar", "pose q = T gap: height of the centre"),
    Signal("psi_ref_rad", "rad", "float32", "scalar", "reference of psi"),
    Signal("theta_ref_rad", "rad", "float32", "scalar", "reference of theta"),
    Signal("z_ref_m", "m", "float32", "scalar", "reference of z"),
    Signal("v_psi_n_m", "N m", "float32", "scalar", "excitation v of the psi torque"),
    Signal("v_theta_n_m", "N m", "float32", "scalar", "excitation v of the theta torque"),
    Signal("v_z_n", "N", "float32", "scalar", "excitation v of the z force"),
    Signal("coil_excitation_n", "N", "float32", "coil", "excitation of each coil, added after T^T"),
    Signal("ff_psi_n_m", "N m", "float32", "scalar", "feed-forward of the psi torque"),
    Signal("ff_theta_n_m", "N m", "float32", "scalar", "feed-forward of the theta torque"),
    Signal("ff_z_n", "N", "float32", "scalar", "feed-forward of the z force"),
    Signal("tau_psi_n_m", "N m", "float32", "scalar", "torque requested: v + PI + feed-forward"),
    Signal("tau_theta_n_m", "N m", "float32", "scalar", "torque requested: v + PI + feed-forward"),
    Signal("tau_z_n", "N", "float32", "scalar", "force requested: v + PI + feed-forward"),
    Signal("coil_n", "N", "float32", "coil", "force commanded, T^T tau + excitation, after limits"),
    Signal("coil_readback_n", "N", "float32", "coil", "amplifier current times nominal constant"),
    Signal("beam_m", "m", "float32", "scalar", "position x_b of the beam"),
    Signal("beam_m_s", "m/s", "float32", "scalar", "velocity of the beam"),
    Signal("beam_force_n", "N", "float32", "scalar", "force of the beam's drives"),
    Signal("beam_ref_m", "m", "float32", "scalar", "reference of the beam's position"),
    Signal("beam_ref_m_s", "m/s", "float32", "scalar", "reference of the beam's velocity"),
    Signal("beam_ref_m_s2", "m/s2", "float32", "scalar", "reference of the beam's acceleration"),
    Signal("rotor_rad", "rad", "float32", "scalar", "angle phi of the rotor"),
    Signal("rotor_rad_s", "rad/s", "float32", "scalar", "angular velocity of the rotor"),
    Signal("rotor_torque_n_m", "N m", "float32", "scalar", "torque of the rotor's drive"),
    Signal("rotor_ref_rad", "rad", "float32", "scalar", "reference of the rotor's angle"),
    Signal("lateness_s", "s", "float32", "scalar", "start of the cycle after its deadline"),
    Signal("execution_s", "s", "float32", "scalar", "time the cycle took"),
    Signal("state", "1", "uint8", "scalar", "state of the loop, a code", State),
    Signal("fault", "1", "uint8", "scalar", "fault, a code; 0 is none", Fault),
    Signal("saturated", "1", "uint8", "scalar", "number of coils at a limit"),
    Signal("skipped", "1", "uint8", "scalar", "periods skipped before this cycle, at most 255"),
    Signal("stale", "1", "uint8", "scalar", "what is an earlier cycle's, bits"),
)

_NUMPY_TYPES = {
    "bool": "?",
    "byte": "u1",
    "char": "u1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}
# byte and char are other names of uint8; the name listed last is the one written.
_ROS_TYPES = {code: name for name, code in _NUMPY_TYPES.items()}

_NAME = re.compile(r"(?!.*__)(?!.*_$)[a-z][a-z0-9_]*")
_FIELD = re.compile(
    r"(?P<type>[A-Za-z0-9_/]+)(?P<bound><=\d+)?(?P<array>\[[^\]]*\])?\s+(?P<rest>.+)"
)
_MAX_RECORD_BYTES = 1 << 20


def cycle_dtype(n_coils: int, n_sensors: int) -> np.dtype[np.void]:
    """Return the packed little-endian dtype of one cycle, in the order of SIGNALS."""
    lengths: dict[str, tuple[int, ...]] = {
        "scalar": (),
        "coil": (n_coils,),
        "sensor": (n_sensors,),
    }
    return np.dtype([(s.name, "<" + _NUMPY_TYPES[s.type], lengths[s.shape]) for s in SIGNALS])


def ros2msg(dtype: np.dtype[np.void], units: Mapping[str, str] | None = None) -> str:
    """Return the ros2msg definition of a record, one line per field: `type name  # [unit] meaning`.

    SIGNALS gives unit and meaning of known fields, `units` the unit of others. ROS 2's own message
    files write units in brackets as well. The names of a field's codes are constants in the lines
    before it, such as `uint8 STATE_IDLE=1`; Foxglove shows a constant that precedes its field.

    Raises:
        LogError: ros2msg has no such name, type or shape of a field, or CDR places the field
            elsewhere.
    """
    known = {s.name: f"[{s.unit}] {s.description}" for s in SIGNALS}
    known |= {name: f"[{unit}]" for name, unit in (units or {}).items()}
    codes = {s.name: s.codes for s in SIGNALS if s.codes is not None}
    lines = []
    for name, field, shape in _fields_of(dtype):
        if not _NAME.fullmatch(name):
            raise LogError(
                f"field '{name}': expected a name of lower case letters, digits and single "
                "underscores, starting with a letter and not ending with an underscore"
            )
        if field.str[1:] not in _ROS_TYPES and field.str != "|b1":
            raise LogError(f"field '{name}': no ros2msg type for {field}")
        if len(shape) > 1:
            raise LogError(f"field '{name}': expected one value or one row, found shape {shape}")
        kind = "bool" if field.str == "|b1" else _ROS_TYPES[field.str[1:]]
        array = f"[{shape[0]}]" if shape else ""
        comment = f"  # {known[name]}" if name in known else ""
        if name in codes and kind == "uint8":
            lines += [f"uint8 {name.upper()}_{code.name}={code.value}" for code in codes[name]]
        lines.append(f"{kind}{array} {name}{comment}")
    text = "\n".join(lines) + "\n"
    if dtype_from_ros2msg(text) != dtype:
        raise LogError(
            f"fields {', '.join(dtype.names or ())}: expected little-endian values where CDR puts "
            "them (each at a multiple of its size); order them by falling size, without gaps"
        )
    return text


def dtype_from_ros2msg(text: str) -> np.dtype[np.void]:
    """Return the little-endian dtype of a ros2msg definition, CDR padding included.

    CDR places a value at the next multiple of its own size, counted from the end of the 4-byte
    header. An array of fixed length has no length prefix and is aligned as its elements are.

    Raises:
        LogError: a field is nested, of variable size, or not valid ros2msg; names the field.
    """
    names: dict[str, None] = {}  # an ordered set
    formats, offsets, end = [], [], 0
    for line in _definition_lines(text):
        name, kind, length = _field_of(line)
        if name in names:
            raise LogError(f"schema: expected distinct field names, found '{name}' twice")
        size = np.dtype(kind).itemsize
        offset = -(-end // size) * size
        end = offset + size * (length or 1)
        if end > _MAX_RECORD_BYTES:
            raise LogError(
                f"schema: field '{name}': the record grows beyond {_MAX_RECORD_BYTES} bytes"
            )
        names[name] = None
        formats.append(kind if length is None else (kind, (length,)))
        offsets.append(offset)
    if not names:
        raise LogError("schema: expected fields of fixed size, found none")
    return np.dtype({"names": list(names), "formats": formats, "offsets": offsets, "itemsize": end})


def _fields_of(
    dtype: np.dtype[np.void],
) -> Iterator[tuple[str, np.dtype[np.generic], tuple[int, ...]]]:
    """Yield name, element type and shape of each field, in order."""
    if dtype.names is None:
        raise LogError(f"expected a record with named fields, found {dtype}")
    for name in dtype.names:
        field = dtype[name]
        yield name, field.base, field.shape


def _definition_lines(text: str) -> Iterator[str]:
    """Yield the field lines of the first definition, without comments and constants."""
    for raw in text.splitlines():
        if raw.startswith("==="):  # definitions of nested types follow
            return
        line = raw.partition("#")[0].strip()
        # A constant (`uint8 FAULT=1`) has '=' after its type, a bound (`string<=10`) within it.
        if line and "=" not in "".join(line.split(None, 1)[1:]):
            yield line


def _field_of(line: str) -> tuple[str, str, int | None]:
    """Return name, numpy type and length (None for a single value) of a field's line."""
    match = _FIELD.fullmatch(line)
    if match is None:
        raise LogError(f"schema: expected 'type name', found '{line[:60]}'")
    name, kind, array = match["rest"].split()[0], match["type"], match["array"]
    if kind in ("string", "wstring"):
        raise LogError(f"schema: field '{name}': {kind} has no fixed size")
    if kind not in _NUMPY_TYPES:
        raise LogError(f"schema: field '{name}': expected a number, found the nested type {kind}")
    numpy_type = np.dtype(_NUMPY_TYPES[kind]).newbyteorder("<").str
    if array is None:
        return name, numpy_type, None
    if re.fullmatch(r"\[[1-9]\d{0,8}\]", array) is None:
        raise LogError(f"schema: field '{name}': {kind}{array} has no fixed size")
    return name, numpy_type, int(array[1:-1])
