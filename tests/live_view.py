"""A daemon with a live view on free ports, for tests."""

from __future__ import annotations

import http.client
import json
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from daemon_process import Daemon, calm, daemon
from waiting import wait_until

from levid.config.rig import load_rig
from levid.config.shipped import shipped

RIG_FILE = shipped("rigs/loopback.yaml")


def free_ports(count: int) -> list[int]:
    """Return ports that were free just now."""
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [found.getsockname()[1] for found in sockets]
    for found in sockets:
        found.close()
    return ports


class Answer(NamedTuple):
    """Answer of an HTTP server."""

    status: int
    headers: Mapping[str, str]
    body: bytes


class LiveView:
    """A running daemon and the ports of its live view."""

    def __init__(self, running: Daemon, port: int, page_port: int) -> None:
        self.daemon, self.port, self.page_port = running, port, page_port
        self.token_file = running.socket.with_name("live-token")

    @property
    def pid(self) -> int | None:
        return self.daemon.ask("status")["pids"]["live"]

    def until_served(self) -> None:
        wait_until(self.listens, 60.0)

    def listens(self) -> bool:
        for port in (self.port, self.page_port):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)):
                    return False
        return True

    def http(self, method: str, path: str, body: bytes = b"", **headers: str) -> Answer:
        """Send a request; headers as keywords, with '_' for '-'."""
        connection = http.client.HTTPConnection("127.0.0.1", self.page_port, timeout=30)
        named = {key.replace("_", "-"): value for key, value in headers.items()}
        connection.request(method, path, body, named)
        answer = connection.getresponse()
        found = Answer(answer.status, dict(answer.getheaders()), answer.read())
        connection.close()
        return found

    def events(self, *names: str) -> dict[str, Any]:
        """Return the first event with each of these names."""
        connection = http.client.HTTPConnection("127.0.0.1", self.page_port, timeout=30)
        connection.request("GET", "/events")
        answer = connection.getresponse()
        assert answer.status == 200
        found: dict[str, Any] = {}
        name = ""
        while not found.keys() >= set(names):
            line = answer.readline().decode().rstrip("\n")
            if line.startswith("event: "):
                name = line.removeprefix("event: ")
            elif line.startswith("data: "):
                found.setdefault(name, json.loads(line.removeprefix("data: ")))
        connection.close()
        return found

    def post(self, name: str, body: Any = None, **headers: str) -> Answer:
        """Send a request as the page does; `headers` replace its own, '' removes one."""
        sent = {
            "Origin": f"http://127.0.0.1:{self.page_port}",
            "X_Levid_Page": "",
            "X_Levid_Token": "",
        } | headers
        if "X_Levid_Page" not in headers:
            sent["X_Levid_Page"] = self.events("rig")["rig"]["page"]
        kept = {key: value for key, value in sent.items() if value}
        return self.http("POST", f"/{name}", json.dumps(body or {}).encode(), **kept)


@contextmanager
def live_view(folder: Path, **live: Any) -> Iterator[LiveView]:
    """Run the shipped rig at 250 Hz with a live view; keys of `live` as in RIG.yaml."""
    port, page_port = free_ports(2)
    settings = {"port": port, "page_port": page_port, **live}
    rig = calm(load_rig(RIG_FILE), folder, live=settings)
    with daemon(rig, RIG_FILE, folder) as running:
        view = LiveView(running, port, page_port)
        view.until_served()
        yield view
