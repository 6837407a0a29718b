"""Test how far the next step of a fit is damped."""

from __future__ import annotations

from levid.identification.trace.search.damping import MOST_DAMPING, less, more


def test_steps_get_shorter_until_one_helps_and_longer_once_two_did() -> None:
    damping = more(0.0)
    assert 0.0 < damping < more(damping) < 1.0
    damping = more(damping)
    assert less(damping, failed=True) == damping
    assert 0.0 < less(damping, failed=False) < damping
    assert less(more(0.0), failed=False) == 0.0


def test_steps_that_never_help_end_after_few() -> None:
    damping, count = 0.0, 0
    while damping <= MOST_DAMPING:
        damping, count = more(damping), count + 1
    assert count < 10
