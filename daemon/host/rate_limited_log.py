"""Log lines that may repeat at most once a minute for each topic, and count those left out."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

_REPEAT_S = 60.0


@dataclass
class _Topic:
    logged_s: float = -math.inf
    suppressed: int = 0
    latest: str = ""


class RateLimitedLog:
    """Pass the first line about a topic to `log`, then one line a minute at most.

    The next line about the topic says how many lines were left out before it. `flush` logs the last
    one of them if no more follow.
    """

    def __init__(self, log: Callable[[str], None], repeat_s: float = _REPEAT_S) -> None:
        self._log, self._repeat_s = log, repeat_s
        self._topics: dict[str, _Topic] = {}

    def line(self, topic: str, now_s: float, text: str) -> None:
        """Log `text`, or count it; `now_s` is a monotonic time in s."""
        before = self._topics.get(topic, _Topic())
        if self.due(topic, now_s):
            self._log(_counted(text, before.suppressed))
        else:
            before.suppressed, before.latest = before.suppressed + 1, text

    def due(self, topic: str, now_s: float) -> bool:
        """Return whether a line may be logged now; if so, count it as logged.

        For lines that contain their own sum.
        """
        if now_s - self._topics.get(topic, _Topic()).logged_s < self._repeat_s:
            return False
        self._topics[topic] = _Topic(now_s)
        return True

    def flush(self, now_s: float) -> None:
        """Log the last suppressed line of each topic whose minute is over."""
        for name, topic in self._topics.items():
            if topic.suppressed and now_s - topic.logged_s >= self._repeat_s:
                self._topics[name] = _Topic(now_s)
                self._log(_counted(topic.latest, topic.suppressed - 1))


def _counted(text: str, suppressed: int) -> str:
    """Return a line with the number of lines that were left out before it."""
    if not suppressed:
        return text
    return f"{text} (and {suppressed} similar event{'s' * (suppressed != 1)} before)"
