"""Log lines that may repeat at most once a minute for each topic, and count those left out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

_REPEAT_S = 60.0


@dataclass
class _Topic:
    logged_s: float
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
        known = self._topics.get(topic)
        if known is not None and now_s - known.logged_s < self._repeat_s:
            known.suppressed, known.latest = known.suppressed + 1, text
            return
        suppressed = known.suppressed if known is not None else 0
        self._topics[topic] = _Topic(now_s)
        self._log(f"{text} (and {_events(suppressed)} before)" if suppressed else text)

    def due(self, topic: str, now_s: float) -> bool:
        """Return whether a line may be logged now; if so, count it as logged.

        For lines that contain their own sum.
        """
        known = self._topics.get(topic)
        if known is not None and now_s - known.logged_s < self._repeat_s:
            return False
        self._topics[topic] = _Topic(now_s)
        return True

    def flush(self, now_s: float) -> None:
        """Log the last suppressed line of each topic whose minute is over."""
        for name, topic in self._topics.items():
            if topic.suppressed and now_s - topic.logged_s >= self._repeat_s:
                more = topic.suppressed - 1
                self._topics[name] = _Topic(now_s)
                before = f" (and {_events(more)} before)" if more else ""
                self._log(f"{topic.latest}{before}")


def _events(count: int) -> str:
    return f"{count} similar event{'s' * (count != 1)}"
