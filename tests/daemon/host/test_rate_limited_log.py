"""Lines that repeat are logged once a minute for each topic; the next line counts the others."""

from __future__ import annotations

from levid.daemon.host.rate_limited_log import RateLimitedLog


def test_first_line_is_logged_at_once_and_repeats_are_counted() -> None:
    logged: list[str] = []
    rarely = RateLimitedLog(logged.append)
    for second in range(60):
        rarely.line("flood", 1000.0 + second, f"flood {second}")
    assert logged == ["flood 0"]
    rarely.line("flood", 1060.0, "flood 60")
    assert logged[1:] == ["flood 60 (and 59 similar events before)"]
    rarely.line("flood", 1061.0, "flood 61")
    rarely.line("flood", 1120.0, "flood 120")
    assert logged[2:] == ["flood 120 (and 1 similar event before)"]


def test_topics_do_not_hide_each_other() -> None:
    logged: list[str] = []
    rarely = RateLimitedLog(logged.append)
    for topic in ("flood", "memory", "flood"):
        rarely.line(topic, 0.0, topic)
    assert logged == ["flood", "memory"]


def test_last_line_is_logged_a_minute_later_if_no_other_follows() -> None:
    logged: list[str] = []
    rarely = RateLimitedLog(logged.append)
    for second in range(3):
        rarely.line("flood", float(second), f"flood {second}")
    rarely.flush(59.0)
    assert logged == ["flood 0"]
    for second in (60.0, 61.0, 200.0):
        rarely.flush(second)
    assert logged[1:] == ["flood 2 (and 1 similar event before)"]


def test_line_with_its_own_sum_is_due_once_a_minute() -> None:
    rarely = RateLimitedLog(lambda _: None)
    assert [rarely.due("rows", s) for s in (0.0, 59.0, 60.0, 61.0)] == [True, False, True, False]
