"""Test that logs of different plants are refused, and both are named."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import pytest

from levid.config.shipped import shipped
from levid.identification.records.one_plant import require_one_plant
from levid.log.errors import LogError

RIG = shipped("rigs/loopback.yaml").read_bytes()
SIGNALS = b"""
levid: signals
rate_hz: 100
columns:
  - {column: 0, name: u_n, unit: N, role: input}
  - {column: 1, name: x_m, unit: m, role: output}
"""


@dataclass
class Head:
    path: Path
    attachments: dict[str, bytes] = field(default_factory=dict)


def head(name: str, rig: bytes | None = None, signals: bytes | None = None) -> Head:
    files = {"rig.yaml": rig, "signals.yaml": signals}
    return Head(Path(name), {key: text for key, text in files.items() if text is not None})


FIRST = head("a.mcap", RIG)
IMPORTED = head("a.mcap", signals=SIGNALS)


@pytest.mark.parametrize(
    ("first", "other", "words"),
    [
        (FIRST, head("b.mcap", RIG.replace(b"name: loopback", b"name: other")), "'other'"),
        (
            FIRST,
            head("b.mcap", RIG.replace(b"coil_x_m: [0.12,", b"coil_x_m: [0.11,")),
            r"the first coil at \(0.12, 0.12\) m, against .* at \(0.11, 0.12\) m",
        ),
        (FIRST, head("b.mcap", signals=SIGNALS), "with imported data"),
        (IMPORTED, head("b.mcap", RIG), "with imported data and b.mcap of the rig 'loopback'"),
        (FIRST, head("b.mcap"), "without a rig.yaml"),
        (
            IMPORTED,
            head("b.mcap", signals=SIGNALS.replace(b"unit: m,", b"unit: rad,")),
            "x_m is in m and in rad",
        ),
        (
            IMPORTED,
            head("b.mcap", signals=SIGNALS.replace(b"u_n", b"f_n")),
            "no input in common, u_n and f_n",
        ),
    ],
    ids=["name", "geometry", "imported", "rig", "neither", "unit", "signals"],
)
def test_logs_of_two_plants_are_refused_and_named(first: Head, other: Head, words: str) -> None:
    with pytest.raises(LogError, match=words) as refused:
        require_one_plant([first, first, other])
    for log in (first, other):
        assert str(log.path) in str(refused.value)


def test_flights_of_one_rig_may_differ_in_gains_limits_and_backend() -> None:
    other = RIG.replace(b"kp_n_m: 500", b"kp_n_m: 400").replace(b"coil_n: 20", b"coil_n: 19")
    require_one_plant([FIRST, head("b.mcap", other)])


def test_imported_records_may_have_further_columns_and_other_rates() -> None:
    more = SIGNALS.replace(b"rate_hz: 100", b"rate_hz: 200")
    more += b"  - {column: 2, name: y_m, unit: m, role: output}\n"
    require_one_plant([IMPORTED, head("b.mcap", signals=more)])


def test_one_log_with_an_invalid_rig_is_left_to_those_who_need_the_rig() -> None:
    broken = head("a.mcap", b"levid: rig\n")
    require_one_plant([broken, broken])
    with pytest.raises(LogError, match=r"a\.mcap: rig\.yaml: "):
        require_one_plant([broken, FIRST])
