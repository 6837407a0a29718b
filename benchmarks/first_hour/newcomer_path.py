"""Walk the path of a newcomer from a fresh clone, with the README's commands only, and time it.

Demo, report in the browser, a changed session, its trace, Python, a flight through the daemon with
the screen of `levid watch`, and the live view. Every command stands in README.md or docs/live.md;
the benchmark fails otherwise. The report is opened in Chromium, the screen in tmux; a step whose
program is missing is not measured. Pictures of all pages at the width of a desktop and of a phone,
and the screen of `levid watch`, are written to build/screenshots: look at them. --quick: without
the demo and the trace, but with their installation.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import NamedTuple

from levid.benchmarks.harness import benchmark_runner
from levid.benchmarks.harness.benchmark_runner import Figure
from levid.benchmarks.harness.start_and_end_processes import started

ROOT = Path(__file__).resolve().parents[2]
PICTURES = ROOT / "build" / "screenshots"
_WIDTHS_PX = (1400, 390)
_CHROMIUM = ("chromium", "--headless", "--no-sandbox", "--disable-gpu")
_STEP_S = 1800.0
_WAIT_S = 180.0
"""The first start of a daemon compiles its kernels."""
_PYTHON = """
import levid
session = levid.load("out/mine")
print(session)
print(session.identify().parameters)
"""


class Newcomer:
    """A clone, and commands that are run in it as the pages say."""

    def __init__(self, clone: Path) -> None:
        self.clone = clone
        self.pages = "\n".join((clone / p).read_text() for p in ("README.md", "docs/live.md"))
        path = f"{clone / '.venv' / 'bin'}:{os.environ['PATH']}"
        self.environment = {**os.environ, "PATH": path, "PYTHONPATH": ""}

    def do(self, command: str) -> str:
        """Run a command that stands on a page; return what it prints."""
        self._require(command)
        done = subprocess.run(
            command, shell=True, cwd=self.clone, env=self.environment, timeout=_STEP_S,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False,
        )  # fmt: skip
        if done.returncode:
            raise RuntimeError(f"{command}: exit code {done.returncode}: {done.stdout[-1000:]}")
        return done.stdout

    def running(self, command: str) -> AbstractContextManager[subprocess.Popen[bytes]]:
        """Run a command that stands on a page until the body ends."""
        self._require(command)
        return started(
            command.split(), cwd=self.clone, env=self.environment,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip

    def _require(self, command: str) -> None:
        if command not in self.pages:
            raise RuntimeError(f"expected in README.md or docs/live.md: {command}")


class Step(NamedTuple):
    """A step: what it is called, what it does and shows, and the program that it needs, if any.

    slow: --quick leaves it out.
    """

    key: str
    label: str
    take: Callable[[], str]
    program: str = ""
    slow: bool = False


def first_sentence(page: Path) -> str:
    """Return the answer that a browser shows first on a report page."""
    shown = subprocess.run(
        [*_CHROMIUM, "--dump-dom", page.as_uri()],
        capture_output=True, text=True, timeout=_STEP_S, check=True,
    ).stdout  # fmt: skip
    found = re.search(r'<p class="lead">(.*?)</p>', shown, re.DOTALL)
    if found is None:
        raise RuntimeError(f"{page}: expected an answer at its top, found none")
    return re.sub(r"\s+", " ", found[1])


def pictures(clone: Path) -> str:
    """Write a picture of every report page at each width; return their paths."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    written = []
    for page in sorted((clone / "out").rglob("index.html")):
        name = "-".join(page.parent.relative_to(clone / "out").parts)
        for width in _WIDTHS_PX:
            written.append(PICTURES / f"{name}-{width}.png")
            size = (f"--window-size={width},3000", f"--screenshot={written[-1]}")
            drawn = ("--hide-scrollbars", "--virtual-time-budget=4000", *size)
            subprocess.run([*_CHROMIUM, *drawn, page.as_uri()], capture_output=True, check=True)
    return "\n".join(map(str, written))


def changed_session(newcomer: Newcomer) -> str:
    """Copy a session, make its sweep longer, and check it."""
    newcomer.do("cp config/sessions/trace-demo.yaml my-session.yaml")
    file = newcomer.clone / "my-session.yaml"
    text = file.read_text()
    assert "duration_s: 16" in text
    file.write_text(text.replace("duration_s: 16", "duration_s: 20"))
    return newcomer.do("levid check my-session.yaml")


def watched_flight(newcomer: Newcomer) -> str:
    """Fly through the daemon, and return the screen of `levid watch` meanwhile."""
    tmux = ["tmux", "-L", f"levid-{os.getpid()}"]
    with newcomer.running("levid run config/rigs/loopback.yaml"):
        _until(lambda: ": idle" in newcomer.do("levid status"))
        shell = ["new-session", "-d", "-x", "100", "-y", "30", "levid watch"]
        subprocess.run([*tmux, *shell], env=newcomer.environment, check=True)
        try:
            flight = "levid excite config/sessions/beam.yaml --out out/daemon"
            with newcomer.running(flight) as process:

                def screen() -> str:
                    shown = [*tmux, "capture-pane", "-p"]
                    return subprocess.run(shown, capture_output=True, text=True, check=False).stdout

                seen = _until(lambda: screen() if "MOVING" in screen().upper() else "")
                process.wait(_STEP_S)
                if process.returncode:
                    raise RuntimeError(f"{flight}: exit code {process.returncode}")
                PICTURES.mkdir(parents=True, exist_ok=True)
                (PICTURES / "watch.txt").write_text(seen)
                return seen
        finally:
            subprocess.run([*tmux, "kill-server"], check=False)


def live_page(newcomer: Newcomer) -> str:
    """Start the daemon with a live view, and return the page that a browser gets."""
    newcomer.do(".venv/bin/pip install --editable '.[live]'")
    rig = newcomer.clone / "config" / "rigs" / "loopback.yaml"
    rig.write_text(rig.read_text() + "live: {}\n")
    newcomer.do("levid check config/rigs/loopback.yaml")
    with newcomer.running("levid run config/rigs/loopback.yaml"):

        def page() -> str:
            with contextlib.suppress(OSError):
                answer = urllib.request.urlopen("http://127.0.0.1:8080", timeout=5.0)
                return str(answer.read().decode())
            return ""

        return _until(page)


def _until(found: Callable[[], str | bool]) -> str:
    give_up_s = time.monotonic() + _WAIT_S
    while not (value := _tried(found)):
        if time.monotonic() > give_up_s:
            raise RuntimeError(f"expected this within {_WAIT_S:g} s: {found.__name__}")
        time.sleep(0.2)
    return str(value)


def _tried(found: Callable[[], str | bool]) -> str | bool:
    try:
        return found()
    except RuntimeError:
        return False


def measure(quick: bool) -> Iterator[Figure]:
    """Walk the path; yield the time of each step."""
    with tempfile.TemporaryDirectory() as folder:
        clone = Path(folder) / "levid"
        subprocess.run(["git", "clone", "-q", str(ROOT), str(clone)], check=True)
        newcomer = Newcomer(clone)

        def python() -> str:
            return subprocess.run(
                [clone / ".venv" / "bin" / "python", "-c", _PYTHON], cwd=clone,
                env=newcomer.environment, capture_output=True, text=True, check=True,
            ).stdout  # fmt: skip

        def install() -> str:
            # What `make demo` does first.
            command = ["make", ".venv/.installed-runtime"]
            subprocess.run(command, cwd=clone, check=True, capture_output=True)
            return ""

        flown = "levid excite my-session.yaml --virtual --sim config/sims/undeclared.yaml "
        found = clone / "out" / "demo-1" / "trace" / "found" / "index.html"
        traced = "levid trace out/mine/*.mcap --out out/mine/found"
        steps = (
            Step("install", "installation", install),
            Step("demo", "make demo", lambda: newcomer.do("make demo"), slow=True),
            Step(
                "report", "report in the browser", lambda: first_sentence(found), "chromium",
                slow=True,
            ),
            Step("session", "change and check a session", lambda: changed_session(newcomer)),
            Step("flight", "fly it", lambda: newcomer.do(f"{flown}--out out/mine")),
            Step("trace", "trace it", lambda: newcomer.do(traced), slow=True),
            Step("python", "load and identify in Python", python),
            Step("pictures", "pictures of all pages", lambda: pictures(clone), "chromium"),
            Step("watch", "daemon and watch", lambda: watched_flight(newcomer), "tmux"),
            Step("live", "live page", lambda: live_page(newcomer)),
        )  # fmt: skip
        for step in steps:
            if (step.slow and quick) or (step.program and not shutil.which(step.program)):
                continue
            begin_s = time.monotonic()
            shown = step.take()
            took_s = time.monotonic() - begin_s
            print(f"== {step.label}: {took_s:.0f} s\n{shown[-1500:]}", file=sys.stderr)
            yield Figure(f"{step.key}_s", took_s, "s", step.label)


if __name__ == "__main__":
    benchmark_runner.run("Path of a newcomer", measure)
