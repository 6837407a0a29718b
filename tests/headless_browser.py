"""A headless Chromium for tests, which are skipped where there is none."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from levid.benchmarks.harness import headless_browser
from levid.benchmarks.harness.headless_browser import Page, find_browser

__all__ = ["Page", "browser", "find_browser"]


@contextmanager
def browser(profile: Path) -> Iterator[Page]:
    """Start a browser with an empty profile; end it after the `with` body."""
    if find_browser() is None:
        pytest.skip("no Chromium in PATH")
    with headless_browser.browser(profile) as page:
        yield page
