"""Fixtures of the tests of drivers."""

from __future__ import annotations

import pytest

from levid.drivers.bus_backend import AnswerTime


class Patience:
    """Deadline of the answers on a bus: `seconds` after SYNC, which a test may change any time."""

    def __init__(self) -> None:
        self.seconds = 30.0

    def deadline_s(self, now_s: float, _: float) -> float:
        return now_s + self.seconds


@pytest.fixture
def patience(monkeypatch: pytest.MonkeyPatch) -> Patience:
    """The deadline of all backends that the test opens; by default nothing is late."""
    patience = Patience()
    monkeypatch.setattr(AnswerTime, "of", lambda _: patience)
    return patience
