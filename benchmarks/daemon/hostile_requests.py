"""Send hostile requests in flight: measure the longest gap between the supervisor's heartbeats.

A platform levitates on the loopback rig in real time. Known hostile requests and requests generated
by Hypothesis are sent one by one; an observer in another process measures the gaps, also for as
long without a request. First on an idle machine, then beside two processes that compute
continuously. --quick: 40 requests each, otherwise 300 in 20 minutes.
"""

from __future__ import annotations

import contextlib
import json
import socket
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from levid.benchmarks.harness import benchmark_runner
from levid.benchmarks.harness.benchmark_runner import Figure, Target
from levid.benchmarks.harness.running_daemon import Daemon, loopback_rig, running
from levid.benchmarks.harness.start_and_end_processes import busy
from levid.benchmarks.harness.supervisor_heartbeat import Heartbeat
from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.api.control_server import LONGEST_LINE
from levid.daemon.client import DaemonError

SHARE = 0.1
"""Share of service.supervisor_s for which a request may block the supervisor."""
STALL_S = 0.2
"""Limit of the rig: a virtual machine's host stalls for some 10 ms, whatever is requested."""
_ANSWER_S = 120.0

_SESSION = shipped("sessions/beam.yaml").read_text()


def _excite(session: str) -> str:
    return json.dumps({"op": "excite", "out": "x", "session": session})


def _move(n: int, key: str) -> str:
    return json.dumps({"op": "move", "move": {f"{key}{i}": i for i in range(n)}})


KNOWN = (
    _move(45_000, "key_number_"),
    _excite(f"levid: session\nname: {'1' * 20_000}e\n"),
    _excite("levid: session\n" + "".join(f"key{i}: 1\n" for i in range(20_000))),
    "[" * 1_000_000,
    json.dumps({"op": "status", "padding": "x" * 1_000_000}),
    _excite(_SESSION + "#" * (1 << 17)),  # a session of the maximum length
)
_PIECES = st.sampled_from((
    "[", "{", '{"a":', "1", "9" * 50, '"', '"\\u0000"', "- ", "&a ", "*a, ", "é", "\\n", "? ", ": ",
    "1:", "<<: ", "!!python/name:os.system ", "0x", ".e", "\t", " ", "'", "|", "#", ", ",
))  # fmt: skip
_LONG = st.builds(
    lambda first, times, piece: (first + piece * times)[: LONGEST_LINE - 200],
    _PIECES, st.integers(1, 300_000), _PIECES,
)  # fmt: skip
_SESSIONS = st.builds(
    lambda at, piece, times: _SESSION[:at] + piece * times + _SESSION[at:],
    st.integers(0, len(_SESSION)), _PIECES, st.integers(1, 20_000),
)  # fmt: skip
_OPS = st.sampled_from(["status", "watch ", "levitate", "move", "excite", "fly", ""])
_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=30),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=9), inner),
    max_leaves=30,
)
REQUESTS = (
    st.builds(lambda op, value: json.dumps({"op": op, op: value}), _OPS, _JSON)
    | (_SESSIONS | _LONG).map(_excite)
    | st.builds(_move, st.integers(1, 60_000), st.sampled_from(["k", "beam_m", "x" * 15]))
    | _LONG
    | st.binary(max_size=3000).map(lambda data: data.decode("latin-1"))
)


def measure(quick: bool) -> Iterator[Figure]:
    """Send requests under both loads; yield the figures."""
    none, lines = Target(most=0), requests(40 if quick else 300)
    yield Figure("asked", len(lines), "", "requests in flight under each load")
    with tempfile.TemporaryDirectory() as name:
        file, path = loopback_rig(Path(name), stall_s=STALL_S), Path(name) / "levid.sock"
        most = Target(most=SHARE * load_rig(file).service.supervisor_s)
        for load, processes in (("idle", 0), ("busy", 2)):
            with running(file, path) as daemon, busy(processes):
                heartbeat = Heartbeat(file, daemon.pids["supervisor"])
                with contextlib.closing(heartbeat):
                    found = np.array([send(daemon, heartbeat, line) for line in lines])
            gap_s, rest_s = found[:, :2].max(axis=0)
            dropped, unanswered = found[:, 2:].sum(axis=0)
            label = f"{load}: longest gap between heartbeats"
            yield Figure(f"gap_{load}", gap_s, "s", label, f"rest_{load}", most)
            yield Figure(f"rest_{load}", rest_s, "s", "the same, no request")
            yield Figure(f"dropped_{load}", dropped, "", "flights ended", target=none)
            yield Figure(f"unanswered_{load}", unanswered, "", "without an answer", target=none)


def requests(count: int) -> list[str]:
    """Return the known requests, and `count` generated ones, the same in every run."""
    found = list(KNOWN)
    once = settings(
        max_examples=count, deadline=None, database=None, derandomize=True,
        phases=[Phase.generate], suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    once(given(REQUESTS)(lambda line: found.append(line)))()  # noqa: PLW0108 - has a signature
    return found


def send(daemon: Daemon, heartbeat: Heartbeat, line: str) -> tuple[float, float, bool, bool]:
    """Return the longest gap in s with a request, and without; whether the flight ended, no answer.

    The stretch without a request is as long.
    """
    _fly(daemon)
    heartbeat.take()
    begun_s = time.monotonic()
    unanswered = not _answered(daemon.socket, line)
    gap_s = heartbeat.take()
    status = daemon.ask("status")
    dropped = status["fault"] != "NONE"
    if dropped:
        print(f"{line[:60]}: {status['fault']}: {status['detail']}", file=sys.stderr)
    heartbeat.take()
    time.sleep(min(max(time.monotonic() - begun_s, 0.1), 2.0))
    return gap_s, heartbeat.take(), dropped, unanswered


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


if __name__ == "__main__":
    benchmark_runner.run("Control socket", measure)
