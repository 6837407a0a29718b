"""List the signals of logs: name, unit, role and meaning of each field."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import overload

from ..log.field_units import field_meanings
from ..log.importing.signals_yaml import attached_signals
from ..log.signals import SIGNALS
from .html_table import Table

_ROLES = (
    ("excitation", ("v_psi_n_m", "v_theta_n_m", "v_z_n", "coil_excitation_n")),
    ("input", ("tau_psi_n_m", "tau_theta_n_m", "tau_z_n", "coil_n")),
    ("output", ("psi_rad", "theta_rad", "z_m", "gap_m")),
    (
        "reference",
        ("psi_ref_rad", "theta_ref_rad", "z_ref_m", "beam_ref_m", "beam_ref_m_s", "beam_ref_m_s2",
         "rotor_ref_rad"),
    ),
    ("scheduling", ("beam_m", "rotor_rad")),
)  # fmt: skip
_RIG_ROLES = {name: role for role, names in _ROLES for name in names}


@dataclass(frozen=True)
class SignalInfo:
    """One signal: field of the log, unit, role (input, output, ...; "" for others), meaning.

    `length`: number of values in a row, one for each coil or sensor; None for a single value.
    """

    name: str
    unit: str
    role: str
    meaning: str
    length: int | None = None

    @property
    def columns(self) -> tuple[str, ...]:
        """Its columns in a data frame: the name, or NAME_0, NAME_1, ... for several values."""
        if self.length is None:
            return (self.name,)
        return tuple(f"{self.name}_{k}" for k in range(self.length))


class SignalTable(Sequence[SignalInfo]):
    """The signals of a session, in the order of the log; displays as a table."""

    def __init__(self, signals: Sequence[SignalInfo]) -> None:
        self._signals = tuple(signals)

    @overload
    def __getitem__(self, key: int | str) -> SignalInfo: ...
    @overload
    def __getitem__(self, key: slice) -> SignalTable: ...
    def __getitem__(self, key: int | str | slice) -> SignalInfo | SignalTable:
        """Return the signal of a number or a name; raises KeyError for an unknown name."""
        if isinstance(key, slice):
            return SignalTable(self._signals[key])
        if isinstance(key, int):
            return self._signals[key]
        for signal in self._signals:
            if signal.name == key:
                return signal
        raise KeyError(f"expected one of {', '.join(s.name for s in self)}; found {key!r}")

    def __len__(self) -> int:
        return len(self._signals)

    def __iter__(self) -> Iterator[SignalInfo]:
        return iter(self._signals)

    def with_role(self, role: str) -> SignalTable:
        """Return the signals of one role: input, output, excitation, reference, scheduling."""
        return SignalTable([s for s in self if s.role == role])

    def __repr__(self) -> str:
        return self._table().text()

    def _repr_html_(self) -> str:
        return self._table().html()

    def _table(self) -> Table:
        rows = [
            (
                s.name if s.length is None else f"{s.name} [{s.length}]",
                "" if s.unit == "1" else s.unit,
                s.role,
                s.meaning,
            )
            for s in self
        ]
        return Table(("signal", "unit", "role", "meaning"), rows)


def listed(columns: Iterable[str] | None) -> list[str] | None:
    """Return names as a list; a text is one name."""
    if columns is None:
        return None
    return [columns] if isinstance(columns, str) else list(columns)


def signals_of(
    schema: str, lengths: Mapping[str, int | None], attachments: Mapping[str, bytes]
) -> tuple[SignalInfo, ...]:
    """Return the signals of a log: its fields with their lengths, described as far as known.

    Units and meanings come from the comments of the ros2msg `schema`, else from levid's table;
    roles from signals.yaml, else from that table.
    """
    known = {s.name: (s.unit, s.description) for s in SIGNALS}
    written = {name: (m.unit, m.meaning) for name, m in field_meanings(schema).items()}
    imported = attached_signals(attachments)
    roles: Mapping[str, str] = _RIG_ROLES
    if imported is not None:
        roles = {c.name: "" if c.role == "other" else c.role for c in imported.columns}
    return tuple(
        SignalInfo(
            name,
            *_described(written.get(name), known.get(name), roles.get(name, "")),
            length,
        )
        for name, length in lengths.items()
    )


def _described(
    written: tuple[str, str] | None, known: tuple[str, str] | None, role: str
) -> tuple[str, str, str]:
    unit, meaning = written or known or ("", "")
    return unit, role, meaning or (known or ("", ""))[1]
