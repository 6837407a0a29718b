"""Test the rig page: who may ask for what, and what Chromium shows and does on a click."""

from __future__ import annotations

import contextlib
import socket
import stat
from collections.abc import Iterator

import pytest
from headless_browser import Page, browser
from live_view import LiveView, live_view
from pictures import picture

EVIL = "https://evil.example"
MOTIONS = ("levitate", "land", "clear", "move")


@pytest.fixture(scope="module")
def view(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveView]:
    with live_view(tmp_path_factory.mktemp("run"), control=True) as running:
        yield running


@pytest.fixture(scope="module")
def page(view: LiveView, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("browser")) as page:
        page.resize()
        page.open(f"http://127.0.0.1:{view.page_port}/")
        page.wait_for("typeof rig === 'object' && rig && pulse.length > 5")
        yield page


@pytest.fixture
def levitating(view: LiveView) -> LiveView:
    if view.daemon.ask("status")["fault"] != "NONE":
        view.daemon.ask("clear")
    if view.daemon.ask("status")["state"] != "LEVITATING":
        view.daemon.ask("levitate", levitate={"check_coils": False})
    view.daemon.until(lambda s: s["state"] == "LEVITATING")
    return view


def token_of(view: LiveView) -> str:
    return view.token_file.read_text().strip()


def test_token_is_in_a_file_that_only_this_user_reads(view: LiveView) -> None:
    assert stat.S_IMODE(view.token_file.stat().st_mode) == 0o600
    assert len(token_of(view)) > 40
    assert any(str(view.token_file) in line for line in view.daemon.said)
    assert not any(token_of(view) in line for line in view.daemon.said)


def test_stop_needs_no_token_of_the_user(levitating: LiveView) -> None:
    answer = levitating.post("stop")
    assert answer.status == 200, answer
    assert levitating.daemon.until(lambda s: s["fault"] == "STOPPED")


@pytest.mark.parametrize(
    "sent",
    [b"", b"POST /stop HTTP/1.1\r\n", b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n"],
    ids=["nothing", "half a head", "a stream"],
)
def test_stop_has_a_place_whatever_other_programs_hold(levitating: LiveView, sent: bytes) -> None:
    """No program needs a right to connect; 200 connections are many times the limit."""
    headers = {"X_Levid_Page": levitating.events("rig")["rig"]["page"]}
    with contextlib.ExitStack() as held:
        for _ in range(200):
            address = ("127.0.0.1", levitating.page_port)
            held.enter_context(socket.create_connection(address)).sendall(sent)
        answer = levitating.post("stop", **headers)
        assert answer.status == 200, answer
        assert levitating.daemon.until(lambda s: s["fault"] == "STOPPED")
        assert levitating.http("GET", "/").status == 200  # the page opens as well


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Origin": EVIL}, 403),
        ({"Origin": ""}, 403),
        ({"Origin": "null"}, 403),
        ({"X_Levid_Page": ""}, 403),
        ({"X_Levid_Page": "a" * 43}, 403),
        ({"Host": "evil.example"}, 421),
        ({"Sec_Fetch_Site": "cross-site", "Origin": ""}, 403),
    ],
)
def test_stop_of_another_page_is_refused(
    levitating: LiveView, headers: dict[str, str], status: int
) -> None:
    assert levitating.post("stop", **headers).status == status
    assert levitating.daemon.ask("status")["fault"] == "NONE"


@pytest.mark.parametrize("name", MOTIONS)
@pytest.mark.parametrize("token", ["", "wrong"])
def test_motion_without_token_is_refused(levitating: LiveView, name: str, token: str) -> None:
    body = {"beam_m": 0.01} if name == "move" else {}
    answer = levitating.post(name, body, X_Levid_Token=token)
    assert answer.status == 403
    assert b"expected the token" in answer.body
    assert levitating.daemon.ask("status")["state"] == "LEVITATING"


@pytest.mark.parametrize("name", [*MOTIONS, "stop"])
def test_get_changes_nothing(levitating: LiveView, name: str) -> None:
    assert levitating.http("GET", f"/{name}").status == 404
    assert levitating.daemon.ask("status")["fault"] == "NONE"


def test_motions_with_token_are_what_the_daemon_does(levitating: LiveView) -> None:
    token = token_of(levitating)
    moved = levitating.post("move", {"beam_m": 0.002}, X_Levid_Token=token)
    assert moved.status == 200, moved
    assert abs(levitating.daemon.ask("status")["beam_m"] - 0.002) < 1e-3
    for wrong in ({"beam_m": "x"}, {"out": 1}, {}):
        assert levitating.post("move", wrong, X_Levid_Token=token).status == 409
    refused = levitating.post("move", {"beam_m": 5.0}, X_Levid_Token=token)
    assert refused.status == 409
    assert levitating.post("land", X_Levid_Token=token).status == 200
    levitating.daemon.until(lambda s: s["state"] == "IDLE")


@pytest.mark.parametrize("host", ["evil.example", "10.0.0.1:8080"])
@pytest.mark.parametrize("path", ["/", "/events"])
def test_another_name_of_this_machine_sees_nothing(view: LiveView, host: str, path: str) -> None:
    answer = view.http("GET", path, Host=host)
    assert answer.status == 421
    assert b"<html" not in answer.body


def test_page_runs_no_script_but_its_own(view: LiveView) -> None:
    first, second = view.http("GET", "/"), view.http("GET", "/")
    policy = first.headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "frame-ancestors 'none'" in policy
    assert "unsafe" not in policy
    assert policy != second.headers["Content-Security-Policy"]
    assert b"://" not in first.body.replace(b"http://www.w3.org/2000/svg", b"")


def test_page_shows_the_flight(levitating: LiveView, page: Page) -> None:
    page.wait_for("document.querySelector('#state').textContent.includes('LEVITATING')")
    assert page.value("document.querySelectorAll('#bars .bar').length") == 5
    total_n = page.value(
        "[...document.querySelectorAll('#platform text:not(.dim)')]"
        ".reduce((sum, text) => sum + Number(text.textContent), 0)"
    )
    assert 60.0 < total_n < 80.0  # the platform weighs 69 N
    page.wait_for("document.querySelector('#events').textContent.includes('LEVITATING')")
    height = page.value("document.querySelectorAll('#bars output')[2].textContent")
    assert height.endswith("µm")
    assert abs(float(height.split()[0])) < 100.0


@pytest.mark.parametrize(("width", "height"), [(1400, 1000), (390, 844)])
def test_page_fits_its_window(page: Page, width: int, height: int) -> None:
    page.resize(width, height)
    for dark in (False, True):
        page.medium(dark=dark)
        assert page.value("document.documentElement.scrollWidth") == width
        box = page.value(
            "(() => { const b = document.querySelector('#stop').getBoundingClientRect();"
            " return [b.left, b.right, b.top, b.bottom, b.height]; })()"
        )
        assert 0 <= box[0] < box[1] <= width
        assert 0 <= box[2] < box[3] <= height
        assert box[4] >= 44  # what a thumb hits
        page.screenshot(picture(f"live-{width}-{'dark' if dark else 'light'}.png"))
    page.resize()


def test_motion_asks_first(levitating: LiveView, page: Page) -> None:
    page.click("[data-ask=land]")
    page.wait_for("document.querySelector('#confirm').open")
    assert levitating.daemon.ask("status")["state"] == "LEVITATING"
    page.value("document.querySelector('#token').value = 'wrong'")
    page.click("#go")
    page.wait_for("document.querySelector('#answer').textContent.includes('expected the token')")
    assert levitating.daemon.ask("status")["state"] == "LEVITATING"
    page.errors.clear()  # Chromium reports the refusal
    page.click("[data-ask=land]")
    page.value(f"document.querySelector('#token').value = {token_of(levitating)!r}")
    page.click("#go")
    levitating.daemon.until(lambda s: s["state"] == "IDLE")
    assert not page.errors


def test_stop_stops_on_the_first_click(levitating: LiveView, page: Page) -> None:
    page.click("#stop")
    levitating.daemon.until(lambda s: s["fault"] == "STOPPED")
    page.wait_for("!document.querySelector('#alert').hidden")
    assert "STOPPED" in page.value("document.querySelector('#alert').textContent")
    assert not page.errors
