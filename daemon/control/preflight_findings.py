"""What a check before lift-off found: whether it passed, what was measured, what to do about it."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any


class Check(StrEnum):
    """The checks before lift-off, by the name with which a request overrides one."""

    DEVICES = "devices"
    AMPLIFIERS = "amplifiers"
    RECORDER = "recorder"
    DISK = "disk"
    REAL_TIME = "real_time"
    CPU = "cpu"
    LOOP = "loop"
    MOTION = "motion"


class Outcome(StrEnum):
    """How a check ended; `unknown` where it cannot be made here, or not yet."""

    PASSED = "passed"
    FAILED = "failed"
    UNKNOWN = "unknown"


OF_TIMING = frozenset({Check.REAL_TIME, Check.CPU})
"""Checks that only warn where all devices are emulated: nothing can be damaged by a late cycle."""


@dataclass(frozen=True)
class Finding:
    """The outcome of one check. found: what was measured, beside what is expected. remedy: what to
    do if it failed; empty if it did not."""

    check: Check
    outcome: Outcome
    found: str
    remedy: str = ""

    @classmethod
    def of(cls, check: Check, passed: bool, found: str, remedy: str) -> Finding:
        """Return a finding that passed or failed; the remedy counts only if it failed."""
        outcome = Outcome.PASSED if passed else Outcome.FAILED
        return cls(check, outcome, found, "" if passed else remedy)

    @property
    def failed(self) -> bool:
        """Whether the check failed."""
        return self.outcome is Outcome.FAILED

    def __str__(self) -> str:
        remedy = f" ({self.remedy})" if self.remedy else ""
        return f"{self.check}: {self.found}{remedy}"

    def as_json(self) -> dict[str, Any]:
        """Return the finding as a JSON object."""
        return {key: str(value) for key, value in asdict(self).items()}


def refusing(
    findings: Iterable[Finding], overridden: Collection[str], emulated: bool
) -> list[Finding]:
    """Return the failed checks that forbid a lift-off.

    overridden: names of checks that the client takes upon itself. emulated: whether no device of
    the rig is real, so that those of timing only warn.
    """
    return [
        f
        for f in findings
        if f.failed and f.check not in overridden and not (emulated and f.check in OF_TIMING)
    ]


def check_names(names: Iterable[str]) -> tuple[Check, ...]:
    """Return the checks with these names; raise ValueError for another name."""
    known = {str(check): check for check in Check}
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(f"expected one of {', '.join(known)}, found {unknown[0]!r}")
    return tuple(known[name] for name in names)
