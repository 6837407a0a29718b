"""Requests to a device between cycles: which answer is taken, and what a refusal is called."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import pytest

from levid.drivers.amplifier_enabling import AmplifierWatch
from levid.drivers.base import AmplifierError, LinkError
from levid.drivers.can.amplifiers_and_adc import Requests
from levid.wire.can.can_frames import load_frames
from levid.wire.device_protocol import DeviceParameter, Refusal, Request

FRAMES = load_frames(None, 9, 9, True)


class Link:
    """A bus on which each request brings what a test has for it."""

    what = "can main"
    remedy = "check power"

    def __init__(self, *answers: list[tuple[int, int]]) -> None:
        self._answers, self._coming = deque(answers), deque[tuple[int, int]]()
        self._hear: Callable[[int, bytes], None] = lambda *_: None

    def listen(self, _: int, hear: Callable[[int, bytes], None]) -> None:
        self._hear = hear

    def drain(self) -> None:
        while self.receive(0.0):
            pass

    def send(self, _: int, __: bytes) -> None:
        self._coming.extend(self._answers.popleft() if self._answers else ())

    def receive(self, _: float) -> bool:
        if not self._coming:
            return False
        self._hear(*FRAMES.answer.encode(*self._coming.popleft()))
        return True


def asked(*answers: list[tuple[int, int]]) -> Requests:
    return Requests(Link(*answers), FRAMES.request, FRAMES.answer)  # type: ignore[arg-type]


def test_answer_to_an_earlier_question_is_not_taken_for_this_one() -> None:
    """A device that booted late answers what was asked before, too."""
    questions = asked([(DeviceParameter.PROTOCOL, 2), (DeviceParameter.COILS, 9)])
    assert questions.exchange(Request.READ, DeviceParameter.COILS, 0) == (DeviceParameter.COILS, 9)
    with pytest.raises(LinkError, match="no answer"):
        asked(*[[(DeviceParameter.PROTOCOL, 2)]] * 20).exchange(
            Request.READ, DeviceParameter.COILS, 0
        )


def test_refusal_is_an_answer_to_anything() -> None:
    refused = (Refusal.NO_SUCH_PARAMETER, DeviceParameter.COILS)
    assert asked([refused]).exchange(Request.READ, DeviceParameter.COILS, 0) == refused


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        ((Refusal.STILL_TRIPPED, 0b101), "still tripped, coil 0, 2"),
        ((DeviceParameter.TRIPPED_COILS, 0b10), "still tripped, coil 1"),
        ((Refusal.NO_SUCH_PARAMETER, 3), r"cannot reset trips \(NO_SUCH_PARAMETER\)"),
    ],
)
def test_trips_that_are_not_reset_say_which(answer: tuple[int, int], words: str) -> None:
    watch = AmplifierWatch("amplifiers", dict.fromkeys(DeviceParameter, 0), lambda *_: None, 2)
    with pytest.raises(AmplifierError, match=words):
        watch.reset(lambda *_: answer)
