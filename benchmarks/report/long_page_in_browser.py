"""Open the page of half an hour at 1 kHz in Chromium, and zoom in it: size, times, frames.

The session is flown in virtual time. Opened: from the request to the last chart on the screen.
Frame times are those between two frames while the wheel zooms in and out over the longest chart,
which a browser without a graphics processor draws. --quick: three minutes of flight.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import yaml

from levid.api.flight import fly
from levid.benchmarks.harness import benchmark_runner
from levid.benchmarks.harness.benchmark_runner import Figure, Target
from levid.benchmarks.harness.headless_browser import Page, browser
from levid.report.plotting.html_page import MOST_BYTES
from levid.report.session.session_page import session_report

REPEATS, TURNS = 5, 60
_WHEEL, _CTRL = 120.0, 2
_OPENED = """
new Promise(done => {
  const figures = document.querySelectorAll('figure .chart-data').length;
  const look = () => document.querySelectorAll('figure.live').length >= figures
    && document.querySelectorAll('figure.live .u-over').length >= figures
    ? requestAnimationFrame(() => done(performance.now())) : requestAnimationFrame(look);
  look();
})"""
"""Milliseconds from the begin of the navigation to the frame with all charts; not too early where
the page was complete long before, as the program asks for it at once."""
_SHOWN = "document.querySelector('figure.live').innerText"
_COUNT = """
window.frames_ms = []; window.counting = true;
(() => {
  let last = performance.now();
  const count = now => {
    frames_ms.push(now - last); last = now;
    if (counting) requestAnimationFrame(count);
  };
  requestAnimationFrame(count);
})()"""


def measure(quick: bool) -> Iterator[Figure]:
    """Fly, write the page, open it and zoom."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        fly(yaml.safe_load(_session(60.0 if quick else 600.0)), out=folder / "logs")
        page = session_report(sorted((folder / "logs").glob("*.mcap")), folder / "page")
        size = page.stat().st_size
        target = Target(most=MOST_BYTES)
        yield Figure("bytes", size / 1e6, "MB", "page", target=Target(most=target.most / 1e6))
        with browser(folder / "profile") as tab:
            opened = [_opened(tab, page) for _ in range(REPEATS)]
            yield Figure("opened_s", sorted(opened)[REPEATS // 2], "s", "opened, median",
                         target=Target(most=2.0))  # fmt: skip
            yield Figure("opened_most_s", max(opened), "s", "opened, at most")
            frames = sorted(_zoomed(tab))
        for key, share, label in (
            ("median", 0.5, "median"),
            ("p95", 0.95, "95 %"),
            ("most", 1.0, "most"),
        ):
            value = frames[min(int(share * len(frames)), len(frames) - 1)]
            yield Figure(f"frame_{key}_ms", value, "ms", f"time of a frame while zooming, {label}")


def _opened(tab: Page, page: Path) -> float:
    tab.open("about:blank")
    tab.open(page.as_uri())
    tab.wait_for(f"location.href === {page.as_uri()!r} && document.readyState === 'complete'")
    return float(tab.value(_OPENED)) / 1e3


def _zoomed(tab: Page) -> list[float]:
    """Return the times of frames in ms while the wheel turns in the middle of the first chart."""
    left, top, width, height = tab.value(
        "(() => { const e = document.querySelector('figure.live .u-over');"
        " e.scrollIntoView({block: 'center'}); const r = e.getBoundingClientRect();"
        " return [r.left, r.top, r.width, r.height]; })()"
    )
    whole, zoomed = tab.value(_SHOWN), set[str]()
    tab.value(_COUNT)
    for turn in range(TURNS):
        way = -1.0 if turn % 20 < 10 else 1.0  # ten turns in, ten out
        tab.mouse(
            "mouseWheel", left + width / 2, top + height / 2,
            deltaX=0.0, deltaY=way * _WHEEL, modifiers=_CTRL,
        )  # fmt: skip
        zoomed.add(tab.value(_SHOWN))
    tab.value("counting = false")
    if zoomed <= {whole}:
        raise RuntimeError(f"expected another resolution after {TURNS} turns, found '{whole}'")
    frames: list[float] = tab.value("frames_ms")
    return frames[1:]


def _session(record_s: float) -> str:
    steps = "".join(
        f"  - record: {{name: {name}, duration_s: {record_s:g}, excite: [{name}]}}\n"
        for name in ("psi", "theta", "z")
    )
    return f"""
levid: session
name: long
rate_hz: 1000
seed: 1
excitations:
  psi: {{input: psi, rms_n_m: 0.1}}
  theta: {{input: theta, rms_n_m: 0.1}}
  z: {{input: z, rms_n: 1.3}}
steps:
  - levitate: {{}}
{steps}  - land: {{}}
"""


if __name__ == "__main__":
    benchmark_runner.run("A long page in the browser", measure)
