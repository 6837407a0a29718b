"""Test the application of `levid watch` from inside: reconnecting, refusals, questions."""

from __future__ import annotations

import asyncio
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
from daemon_process import Daemon, calm, daemon
from textual.pilot import Pilot

from levid.cli.watch.dashboard import draw
from levid.cli.watch.screen import WatchApp
from levid.cli.watch.styled_lines import plain
from levid.config.rig import load_rig
from levid.config.shipped import shipped

RIG_FILE = shipped("rigs/loopback.yaml")
WAIT_S, POLL_S = 60.0, 0.02


def text_of(app: WatchApp) -> str:
    return plain(draw(app.view, *app.size))


async def until(pilot: Pilot[None], app: WatchApp, *texts: str) -> str:
    for _ in range(round(WAIT_S / POLL_S)):
        if all(text in text_of(app) for text in texts):
            return text_of(app)
        await pilot.pause(POLL_S)
    raise AssertionError(f"{texts} not in\n{text_of(app)}")


@pytest.fixture
def app(tmp_path: Path) -> WatchApp:
    return WatchApp(lambda: tmp_path / "levid.sock", 0.1)


def test_it_waits_for_a_daemon_and_reconnects(app: WatchApp, tmp_path: Path) -> None:
    def running() -> AbstractContextManager[Daemon]:
        return daemon(calm(load_rig(RIG_FILE), tmp_path), RIG_FILE, tmp_path)

    async def body(pilot: Pilot[None]) -> None:
        await until(pilot, app, "NOT CONNECTED", "levid run RIG.yaml")
        await pilot.press("l")
        await until(pilot, app, "not connected to the daemon")
        await pilot.press("s")
        await until(pilot, app, "NOT STOPPED: use the emergency stop")
        with running() as first:
            await until(pilot, app, "IDLE", "coils in N")
            await keys_ask_only_if_there_is_something_to_do(pilot, app, first)
        await until(pilot, app, "NOT CONNECTED")
        with running():
            await until(pilot, app, "IDLE", "connected to the daemon again")
            await every_size_is_painted(pilot, app)

    async def session() -> None:
        async with app.run_test(size=(100, 30)) as pilot:
            await body(pilot)

    asyncio.run(session())


async def keys_ask_only_if_there_is_something_to_do(
    pilot: Pilot[None], app: WatchApp, running: Daemon
) -> None:
    await pilot.press("l")
    await until(pilot, app, "no flight to land")
    await pilot.press("c")
    await until(pilot, app, "no fault to clear")
    await pilot.press("question_mark")
    await until(pilot, app, "how to read the screen")
    await pilot.press("S")  # also from the help page, also with caps lock
    await asyncio.to_thread(running.until, lambda status: status["fault"] == "STOPPED")
    await pilot.press("question_mark")
    await until(pilot, app, "FAULT STOPPED", "press c")
    await pilot.press("c")
    await until(pilot, app, "Clear the fault?")
    await pilot.press("escape")
    await until(pilot, app, "did not clear")
    assert running.ask("status")["fault"] == "STOPPED"
    assert "Clear" not in text_of(app).splitlines()[-1]


async def every_size_is_painted(pilot: Pilot[None], app: WatchApp) -> None:
    for size in ((160, 50), (60, 20), (20, 5), (100, 30)):
        await pilot.resize_terminal(*size)
        await pilot.pause()
        assert app.size == size
    picture = app.export_screenshot()
    assert "sensors," in picture
    assert "IDLE" in picture
