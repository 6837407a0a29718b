"""Send hostile requests in flight: measure the supervisor's heartbeat and late cycles.

A platform levitates on the loopback rig in real time. Known hostile requests and requests generated
by Hypothesis are sent one by one. An observer in another process measures the longest gap between
two heartbeats. Stretches with and without requests alternate, first on an idle machine, then beside
two processes that compute continuously. --quick: 40 requests each, otherwise 300 in 20 minutes.
The limit of the heartbeat is service.supervisor_s.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from levid.benchmarks.harness import table
from levid.benchmarks.harness.child_processes import busy
from levid.benchmarks.harness.heartbeat import Heartbeat
from levid.benchmarks.harness.running_daemon import Daemon, loopback_rig, running
from levid.benchmarks.harness.table import Figure, Target
from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.api.control_server import LONGEST_LINE
from levid.daemon.client import DaemonError

SHARE = 0.1
"""Share of the heartbeat's limit that a request may block the supervisor."""
STALL_S = 0.2
"""Limit of the rig: a virtual machine's host stalls for some 10 ms, whatever is requested."""
_ANSWER_S = 120.0
_LEAST_S = 2.0
_BUSY = 2

_SESSION = shipped("sessions/beam.yaml").read_text()


def _excite(session: str = _SESSION, **more: str) -> str:
    return json.dumps({"op": "excite", "out": "x", "session": session, **more})


def _move(n: int, key: str) -> str:
    return json.dumps({"op": "move", "move": {f"{key}{i}": i for i in range(n)}})


KNOWN = {
    "45,000 unknown keys": _move(45_000, "key_number_"),
    "20,000 digits": _excite(f"levid: session\nname: {'1' * 20_000}e\n"),
    "20,000 keys": _excite("levid: session\n" + "".join(f"key{i}: 1\n" for i in range(20_000))),
    "a million brackets": "[" * 1_000_000,
    "a long status": json.dumps({"op": "status", "padding": "x" * 1_000_000}),
    "a session of the maximum length": _excite(_SESSION + "#" * (1 << 17)),
}
_PIECES = st.sampled_from((
    "[", "{", '{"a":', "1", "9" * 50, '"', '"\\u0000"', "- ", "&a ", "*a, ", "é", "\\n", "? ", ": ",
    "1:", "<<: ", "!!python/name:os.system ", "0x", ".e", "\t", " ", "'", "|", "#", ", ",
))  # fmt: skip
_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=30),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=9), inner),
    max_leaves=30,
)
_LONG = st.builds(
    lambda first, times, piece: (first + piece * times)[: LONGEST_LINE - 200],
    _PIECES, st.integers(1, 300_000), _PIECES,
)  # fmt: skip
_SESSIONS = st.builds(
    lambda at, piece, times: _SESSION[:at] + piece * times + _SESSION[at:],
    st.integers(0, len(_SESSION)), _PIECES, st.integers(1, 20_000),
)  # fmt: skip
_OPS = st.sampled_from(["status", "watch ", "levitate", "move", "excite", "fly", ""])
REQUESTS = st.one_of(
    st.builds(
        lambda op, more: json.dumps({**more, "op": op}),
        _OPS,
        st.dictionaries(st.text(max_size=9), _VALUES, max_size=9),
    ),
    (_SESSIONS | _LONG).map(_excite),
    _LONG.map(lambda rig: _excite(rig=rig)),
    st.builds(lambda op, value: json.dumps({"op": op, op: value}), _OPS, _VALUES),
    st.builds(_move, st.integers(1, 60_000), st.sampled_from(["k", "beam_m", "x" * 15])),
    _LONG,
    st.binary(max_size=3000).map(lambda data: data.replace(b"\n", b" ").decode("latin-1")),
)


@dataclass
class Stretches:
    """Results under one load; pairs are (with, without a request)."""

    gaps_s: tuple[list[float], list[float]] = field(default_factory=lambda: ([], []))
    late: list[int] = field(default_factory=lambda: [0, 0])
    cycles: list[int] = field(default_factory=lambda: [0, 0])
    unanswered: int = 0
    dropped: int = 0


def measure(quick: bool) -> Iterator[Figure]:
    """Send requests under both loads; yield the figures."""
    with tempfile.TemporaryDirectory() as name:
        file, path = loopback_rig(Path(name), stall_s=STALL_S), Path(name) / "levid.sock"
        limit_s = load_rig(file).service.supervisor_s
        yield Figure("limit", limit_s, "s", "limit of the heartbeat, service.supervisor_s")
        for load in ("idle", "busy"):
            with running(file, path) as daemon, busy(_BUSY if load == "busy" else 0):
                heartbeat = Heartbeat(file, daemon.pids["supervisor"])
                found = Stretches()
                try:
                    send_all(daemon, heartbeat, found, 40 if quick else 300)
                finally:
                    heartbeat.close()
                yield from _figures(load, found, limit_s)


def send_all(daemon: Daemon, heartbeat: Heartbeat, found: Stretches, count: int) -> None:
    """Send the known requests, then `count` generated ones."""
    for name, line in KNOWN.items():
        _send(daemon, heartbeat, found, line, name)

    @settings(
        max_examples=count,
        deadline=None,
        database=None,
        derandomize=True,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(REQUESTS)
    def generated(line: str) -> None:
        _send(daemon, heartbeat, found, line, line[:60])

    generated()


def _send(daemon: Daemon, heartbeat: Heartbeat, found: Stretches, line: str, name: str) -> None:
    """Measure a stretch with one request, and one of the same length without."""
    _fly(daemon)
    before = daemon.ask("status")
    heartbeat.take()
    begun_s = time.monotonic()
    found.unanswered += not _answered(daemon.socket, line)
    found.gaps_s[0].append(heartbeat.take())
    after = daemon.ask("status")
    if after["fault"] != "NONE":
        found.dropped += 1
        print(f"{name}: {after['fault']}: {after['detail']}", file=sys.stderr)
    heartbeat.take()
    time.sleep(min(max(time.monotonic() - begun_s, 0.1), _LEAST_S))
    found.gaps_s[1].append(heartbeat.take())
    rest = daemon.ask("status")
    for k, (first, last) in enumerate(((before, after), (after, rest))):
        found.late[k] += last["late"] - first["late"]
        found.cycles[k] += last["cycle"] - first["cycle"]


def _fly(daemon: Daemon) -> None:
    """Levitate, whatever the last request caused; raises RuntimeError on a timeout."""
    give_up_s = time.monotonic() + _ANSWER_S
    while (status := daemon.ask("status"))["state"] != "LEVITATING":
        if time.monotonic() > give_up_s:
            raise RuntimeError(f"expected LEVITATING, found {status['state']}: {status['detail']}")
        with contextlib.suppress(DaemonError):
            if status["fault"] != "NONE":
                daemon.ask("clear")
            elif status["state"] == "IDLE":
                daemon.ask("levitate", levitate={"settle_s": 0.2, "check_coils": False})
        time.sleep(0.1)


def _answered(path: Path, line: str) -> bool:
    """Send a line; return whether an answer came."""
    with socket.socket(socket.AF_UNIX) as end:
        end.settimeout(_ANSWER_S)
        end.connect(str(path))
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            end.sendall(line.replace("\n", " ").encode(errors="replace") + b"\n")
        data = b""
        with contextlib.suppress(OSError):
            while piece := end.recv(1 << 16):
                data = data[-8:] + piece
                if b'"ok"' in data:
                    return True
    return False


def _figures(load: str, found: Stretches, limit_s: float) -> Iterator[Figure]:
    shares = [late / max(cycles, 1) for late, cycles in zip(found.late, found.cycles, strict=True)]
    gap_s, rest_s = (max(gaps_s, default=None) for gaps_s in found.gaps_s)
    most, none = Target(most=SHARE * limit_s), Target(most=0)
    yield Figure(f"asked_{load}", len(found.gaps_s[0]), "", f"{load}: requests in flight")
    label = f"{load}: longest gap between heartbeats"
    yield Figure(f"gap_{load}", gap_s, "s", label, f"rest_{load}", most)
    yield Figure(f"rest_{load}", rest_s, "s", f"{load}: the same, no request")
    yield Figure(f"dropped_{load}", found.dropped, "", f"{load}: flights ended", target=none)
    label = f"{load}: requests without an answer"
    yield Figure(f"unanswered_{load}", found.unanswered, "", label, target=none)
    yield Figure(f"late_{load}", shares[0], "", f"{load}: late cycles, share", f"late_rest_{load}")
    yield Figure(f"late_rest_{load}", shares[1], "", f"{load}: the same, no request")


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    table.run("Control socket", measure)
