"""Test all report pages of one flight in a real browser: the answer is what one sees first.

Pictures of each page are kept in build/screenshots.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from headless_browser import Page, browser
from pictures import DESKTOP, PHONE, page_pictures
from short_trace_session import SESSION

from levid.config.shipped import shipped
from levid.report.session.session_page import session_report

# The answer of each page, with the numbers that the simulator was given.
PAGES = {
    "report": r"A flight of 46\ss .* The records are good",
    "identification": "does not explain these records",
    "trace": r"coil 6 gives 2.00\s% less force",
    "comparison": "Gain of a coil at coil 6",
}
SEEN_FIRST = 0.6
"""Share of the first screen in which the whole answer stands."""


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory, run_levid: Callable[..., int]) -> Path:
    """Return a folder with the pages of a flight, and of a comparison of its two results."""
    folder = tmp_path_factory.mktemp("pages")
    session, out, sim = folder / "session.yaml", folder / "out", shipped("sims/undeclared.yaml")
    session.write_text(f"{SESSION}then: [identify, trace]\n")
    assert run_levid("excite", session, "--sim", sim, "--virtual", "--out", out) == 0
    session_report(sorted(out.glob("*.mcap")), out / "report")
    models = [next(out.glob(f"{name}/model.yaml")) for name in ("identification", "trace")]
    assert run_levid("compare", *models, "--out", out / "comparison") == 0
    return out


@pytest.fixture(scope="module")
def window(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.mark.parametrize("name", PAGES)
def test_the_answer_is_what_one_sees_first(pages: Path, window: Page, name: str) -> None:
    file = pages / name / "index.html"
    window.open(file.as_uri())
    for width, height in (DESKTOP, PHONE):
        window.resize(width, height)
        # A chart follows a new width one drawing later.
        window.wait_for(f"document.documentElement.scrollWidth <= {width}")
        bottom, text = window.value(
            "(() => { const lead = document.querySelector('p.lead'); return ["
            "lead.getBoundingClientRect().bottom, lead.innerText]; })()"
        )
        assert re.search(PAGES[name], text), text
        assert bottom < SEEN_FIRST * height
    page_pictures(window, name.replace("/", "-"))
    assert window.errors == []
