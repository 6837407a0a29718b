"""Test which failed checks forbid a lift-off."""

from __future__ import annotations

import pytest

from levid.daemon.control.preflight_findings import (
    Check,
    Finding,
    Outcome,
    check_names,
    refusing,
)


def failed(*checks: Check) -> list[Finding]:
    return [Finding.of(check, False, "found", "remedy") for check in checks]


def test_hardware_is_refused_for_every_failed_check() -> None:
    assert [f.check for f in refusing(failed(*Check), (), emulated=False)] == list(Check)


def test_timing_only_warns_where_nothing_is_real() -> None:
    refused = [f.check for f in refusing(failed(*Check), (), emulated=True)]
    assert refused == [c for c in Check if c not in (Check.REAL_TIME, Check.CPU)]


def test_an_override_counts_for_its_check_only() -> None:
    refused = refusing(failed(Check.DISK, Check.LOOP), (Check.LOOP,), emulated=False)
    assert [f.check for f in refused] == [Check.DISK]


def test_what_is_unknown_or_passed_forbids_nothing() -> None:
    others = [
        Finding(Check.LOOP, Outcome.UNKNOWN, "the rig has no model"),
        Finding.of(Check.DISK, True, "room", "remedy"),
    ]
    assert not refusing(others, (), emulated=False)
    assert others[1].remedy == ""
    assert str(failed(Check.DISK)[0]) == "disk: found (remedy)"
    assert others[0].as_json() == {
        "check": "loop",
        "outcome": "unknown",
        "found": "the rig has no model",
        "remedy": "",
    }


def test_an_unknown_name_is_an_error_that_lists_the_names() -> None:
    assert check_names(["loop", "cpu"]) == (Check.LOOP, Check.CPU)
    with pytest.raises(ValueError, match=r"expected one of devices, .*motion, found 'gravity'"):
        check_names(["gravity"])
