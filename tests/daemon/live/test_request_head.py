"""Test which requests of browsers are refused: other hosts, other pages, malformed heads."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from levid.daemon.live.request_head import BadRequestError, Head, parse_head, require_local


def head(*lines: str, host: str | None = "localhost:8080", method: str = "GET") -> Head:
    hosts = () if host is None else (f"Host: {host}",)
    return parse_head("\r\n".join((f"{method} / HTTP/1.1", *hosts, *lines, "", "")).encode())


@pytest.mark.parametrize("host", ["localhost", "localhost:8080", "127.0.0.1:9000", "LOCALHOST:1"])
def test_this_machine_may_be_named(host: str) -> None:
    require_local(head(host=host))
    require_local(head(f"Origin: http://{host}", host=host))


@pytest.mark.parametrize(
    "host",
    [
        *(None, "", "evil.example", "localhost.evil.example", "127.0.0.1.evil.example:80"),
        *("10.0.0.1", "[::1]:8080", "localhost:80a", "localhost@evil.example", "localhost:80:80"),
    ],
)
def test_any_other_name_is_refused(host: str | None) -> None:
    with pytest.raises(BadRequestError, match="Host: expected localhost") as error:
        require_local(head(host=host))
    assert error.value.status == 421


@pytest.mark.parametrize(
    "origin",
    [
        *("https://evil.example", "null", "file://", "http://localhost:8081", ""),
        *("https://localhost:8080", "http://localhost:8080.evil.example"),
    ],
)
def test_other_pages_are_refused(origin: str) -> None:
    with pytest.raises(BadRequestError, match=r"live\.origins") as error:
        require_local(head(f"Origin: {origin}"))
    assert error.value.status == 403
    require_local(head(f"Origin: {origin}"), [origin])


def test_requests_of_other_sites_without_origin_are_refused_but_links_work() -> None:
    with pytest.raises(BadRequestError, match="other sites"):
        require_local(head("Sec-Fetch-Site: cross-site", "Sec-Fetch-Mode: no-cors"))
    require_local(head("Sec-Fetch-Site: cross-site", "Sec-Fetch-Mode: navigate"))


@pytest.mark.parametrize(
    "raw",
    [
        b"GET /\r\n\r\n",
        b"GET / HTTP/2\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost : a\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost\r\n\r\n",
        b"\r\n\r\n",
    ],
)
def test_malformed_heads_are_refused(raw: bytes) -> None:
    with pytest.raises(BadRequestError):
        parse_head(raw)


@given(st.binary(max_size=300))
def test_any_bytes_are_parsed_or_refused(raw: bytes) -> None:
    with contextlib.suppress(BadRequestError):
        require_local(parse_head(raw))
