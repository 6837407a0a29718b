"""Pictures of what people see, made by tests and kept in build/screenshots: look at them."""

from __future__ import annotations

from io import StringIO
from pathlib import Path

from headless_browser import Page
from repository_folders import ROOT
from rich.ansi import AnsiDecoder
from rich.console import Console
from tmux_terminal import Terminal

PICTURES = ROOT / "build" / "screenshots"
DESKTOP, PHONE = (1400, 1000), (390, 844)
"""Width and height in pixels."""


def page_pictures(page: Page, name: str) -> None:
    """Save the page that is open at the width of a desktop and of a phone."""
    for width, height in (DESKTOP, PHONE):
        page.resize(width, height)
        page.wait_for("new Promise(done => requestAnimationFrame(() => done(true)))")
        page.screenshot(picture(f"{name}-{width}.png"))
    page.resize()


def terminal_picture(screen: Terminal, name: str, width: int) -> None:
    """Save the screen of a terminal with its colours, as SVG."""
    console = Console(record=True, width=width, file=StringIO(), force_terminal=True)
    for line in AnsiDecoder().decode(screen.escapes):
        console.print(line, overflow="crop", no_wrap=True)
    console.save_svg(str(picture(f"{name}.svg")), title=name)


def picture(name: str) -> Path:
    """Return the file of a picture, in its folder."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    return PICTURES / name
