"""Choose columns of a log by field, element or group, and name them in flat tables."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import LogError
from ..importing.signals_yaml import attached_signals
from ..log_stream import Block, LogStream

TIME = "time_s"
LOG_TIME = "log_time_ns"
"""Column of the MCAP log times, for logs without `time_s` and on request."""

_GROUPS = {
    "gaps": ("gap_m",),
    "pose": ("psi_rad", "theta_rad", "z_m"),
    "reference": ("psi_ref_rad", "theta_ref_rad", "z_ref_m"),
    "excitation": ("v_psi_n_m", "v_theta_n_m", "v_z_n", "coil_excitation_n"),
    "feedforward": ("ff_psi_n_m", "ff_theta_n_m", "ff_z_n"),
    "wrench": ("tau_psi_n_m", "tau_theta_n_m", "tau_z_n"),
    "coils": ("coil_n", "coil_readback_n"),
    "beam": ("beam_m", "beam_m_s", "beam_force_n", "beam_ref_m", "beam_ref_m_s", "beam_ref_m_s2"),
    "rotor": ("rotor_rad", "rotor_rad_s", "rotor_torque_n_m", "rotor_ref_rad"),
    "timing": ("lateness_s", "execution_s", "skipped", "stale"),
    "status": ("state", "fault", "saturated"),
}
_ROLE_GROUPS = {
    "inputs": "input",
    "outputs": "output",
    "reference": "reference",
    "excitation": "excitation",
    "scheduling": "scheduling",
}


@dataclass(frozen=True)
class Column:
    """A field of the log, whole or one element of it.

    name: of the variable. field: in the log; LOG_TIME for its log time. element: which value of an
    array field, None for the whole field. length: number of values, None for a single one.
    """

    name: str
    field: str
    unit: str
    meaning: str
    dtype: np.dtype[np.generic]
    length: int | None = None
    element: int | None = None

    @property
    def flat_names(self) -> tuple[str, ...]:
        """Names in a flat table: gap_m_0, gap_m_1, ... for an array field."""
        if self.length is None:
            return (self.name,)
        return tuple(f"{self.name}_{i}" for i in range(self.length))

    def values(self, block: Block) -> NDArray[np.generic]:
        """Return the column's values in a block, (n,) or (n, length)."""
        if self.field == LOG_TIME:
            return block.log_time_ns
        values: NDArray[np.generic] = block.rows[self.field]
        return values if self.element is None else values[:, self.element]

    def flat_values(self, block: Block) -> list[NDArray[np.generic]]:
        """Return the values (n,) in a block for each of `flat_names`."""
        values = self.values(block)
        return [values] if values.ndim == 1 else list(values.T)


def chosen_columns(log: LogStream, names: Sequence[str] = ()) -> tuple[Column, ...]:
    """Return the columns with these names, in their order; all of the log without names.

    A name is a field (`gap_m`), one element (`gap_m_3`), or a group (`pose`): see `groups_of`. The
    time is always the first column: `time_s`, or the log time in ns if the log has no `time_s`.

    Raises:
        LogError: an unknown name, with names that are close.
    """
    known = {c.name: c for c in _fields(log)}
    groups = groups_of(log)
    time = known[TIME] if TIME in known else _log_time()
    if not names:
        return (time, *(c for c in known.values() if c.name != TIME))
    found = {time.name: time}
    for name in names:
        if name in groups:
            found |= {field: known[field] for field in groups[name]}
        elif name == LOG_TIME:
            found[LOG_TIME] = _log_time()
        else:
            column = known.get(name) or _element(known, name)
            if column is None:
                raise LogError(_unknown(log, name, [*known, *groups]))
            found[name] = column
    return tuple(found.values())


def groups_of(log: LogStream) -> dict[str, tuple[str, ...]]:
    """Return the fields of each group of this log; groups of imported logs are those of roles."""
    names = set(log.names)
    signals = attached_signals(log.attachments)
    if signals is not None:
        groups = {
            group: tuple(c.name for c in signals.columns if c.role == role and c.name in names)
            for group, role in _ROLE_GROUPS.items()
        }
    else:
        groups = {g: tuple(f for f in fields if f in names) for g, fields in _GROUPS.items()}
    return {group: fields for group, fields in groups.items() if fields}


def _fields(log: LogStream) -> list[Column]:
    found = []
    for name in log.names:
        field = log.dtype[name]
        about = log.meanings.get(name)
        found.append(
            Column(
                name,
                name,
                "" if about is None else about.unit,
                "" if about is None else about.meaning,
                field.base,
                field.shape[0] if field.shape else None,
            )
        )
    return found


def _log_time() -> Column:
    meaning = "log time since 1970-01-01 UTC"
    return Column(LOG_TIME, LOG_TIME, "ns", meaning, np.dtype("<u8"))


def _element(known: dict[str, Column], name: str) -> Column | None:
    field, _, digits = name.rpartition("_")
    whole = known.get(field)
    if whole is None or whole.length is None or not digits.isdecimal():
        return None
    if int(digits) >= whole.length or name != f"{field}_{int(digits)}":
        return None
    return Column(name, field, whole.unit, whole.meaning, whole.dtype, None, int(digits))


def _unknown(log: LogStream, name: str, names: Sequence[str]) -> str:
    field, _, digits = name.rpartition("_")
    if digits.isdecimal() and field in names:
        shape = log.dtype[field].shape if field in log.names else ()
        if shape:
            return f"{log.path}: no column '{name}': {field} has elements 0 to {shape[0] - 1}"
    close = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(close)}?" if close else f"there is {', '.join(names)}"
    return f"{log.path}: no column '{name}': {hint}"
