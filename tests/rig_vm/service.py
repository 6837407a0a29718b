"""The daemon as a service of a real systemd, from its installation to a power cut.

Run as root in the guest. What is asserted is what happens, not when: the guest is slow, and
stalls with its host.
"""

from __future__ import annotations

import contextlib
import json
import os
import pwd
import re
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from levid.daemon.client import Client, DaemonError
from levid.log.errors import LogError
from levid.log.reader import read_log

HERE = Path(__file__).parent
RESULTS = Path("/rig")
STATE = Path("/var/lib/levid")
RIG = Path("/etc/levid/rig.yaml")
LEVID = "/srv/levid/bin/levid"
PAGE = "http://127.0.0.1:8080"
RATE_HZ = 125
PATIENCE_S = 90.0
MOST_EXPOSED = 2.0
MOST_SKIPPED = 255
LOST_S = 1.0
"""What may be missing of a log when one of its processes was killed: it opens up to its last
second."""
USERS = 'u labuser - "may ask" /run\nm labuser levid\nu stranger - "may not" /run\n'
# What this machine is like, not what the service is: where levid lies, and stalls of seconds.
DROP_IN = """[Service]
Environment=PYTHONPATH=/srv/levid/src PYTHONDONTWRITEBYTECODE=1
WatchdogSec=10
TimeoutAbortSec=60
"""
SESSION = (HERE / "session.yaml").read_text()
LONG = SESSION.replace("duration_s: 4", "duration_s: 600")
BEGAN_S = time.monotonic()


def main() -> None:
    install()
    electronics = subprocess.Popen(
        ["chrt", "--fifo", "20", LEVID, "electronics", str(RIG)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=(RESULTS / "electronics.log").open("w"),
        text=True,
    )
    until(lambda: "emulating" in (RESULTS / "electronics.log").read_text(), "electronics answer")
    for step in (
        starts, shows_itself, refuses, flies, recorder_dies, clock_steps, loop_dies,
        supervisor_dies, loop_hangs,
    ):  # fmt: skip
        step(electronics)
        say(step.__name__)
    power_cut()


def install() -> None:
    """As docs/service.md says."""
    RIG.parent.mkdir()
    plain = yaml.safe_load((HERE / "rig.yaml").read_text())
    plain["rate_hz"] = RATE_HZ  # the loop may take its time, even at real-time priority
    plain["control"] = {
        "psi": {"kp_n_m_rad": 10, "ki_n_m_rad_s": 100},
        "theta": {"kp_n_m_rad": 10, "ki_n_m_rad_s": 100},
        "z": {"kp_n_m": 250, "ki_n_m_s": 1500},
    }
    plain["drives"]["every"] = 4
    plain["amplifiers"]["expire_cycles"] = 2 * RATE_HZ
    plain["sim"] = "/srv/levid/src/levid/config/sims/nominal.yaml"
    plain["realtime"]["priority"] = 1
    plain["service"] = {"loop_s": 4, "supervisor_s": 4}
    plain["live"] = {"rate_hz": 1}  # one processor carries all of this
    RIG.write_text(yaml.safe_dump(plain))
    run(LEVID, "install-service", str(RIG))
    Path("/etc/sysusers.d/zz-rig.conf").write_text(USERS)
    Path("/etc/systemd/system/levid.service.d/50-guest.conf").write_text(DROP_IN)
    run("systemd-sysusers")
    run("udevadm", "control", "--reload")
    run("networkctl", "reload")
    run("systemctl", "daemon-reload")
    run("systemctl", "enable", "systemd-networkd", "levid")  # for the day when its power is cut
    until(Path("/sys/class/net/vcan0").exists, "networkd makes vcan0")
    cache, user = Path("/var/cache/levid/levid"), pwd.getpwnam("levid").pw_uid
    shutil.copytree(cache / "compiled-0", cache / f"compiled-{user}")
    for path in (cache.parent, cache, cache / f"compiled-{user}"):
        shutil.chown(path, "levid", "levid")
    for path in (cache / f"compiled-{user}").iterdir():
        shutil.chown(path, "levid", "levid")
    judged = run("systemd-analyze", "security", "--no-pager", "levid").strip().splitlines()[-1]
    say(judged)
    level = re.search(r"levid\.service: (\d+\.\d+)", judged)
    assert level is not None, judged
    assert float(level[1]) <= MOST_EXPOSED, judged


def starts(_: Any) -> None:
    run("systemctl", "start", "levid")  # comes back when the daemon has said that it is ready
    assert shown("ActiveState") == "active"
    assert shown("StatusText") == "IDLE", shown("StatusText")
    status = status_when(lambda s: s["pids"]["live"] is not None)
    assert status["state"] == "IDLE", status
    levid = pwd.getpwnam("levid").pw_uid
    for name, pid in status["pids"].items():
        assert Path(f"/proc/{pid}").stat().st_uid == levid, name
    assert os.sched_getscheduler(status["pids"]["loop"]) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
    loop = Path(f"/proc/{status['pids']['loop']}")
    assert "VmLck:\t       0 kB" not in (loop / "status").read_text()
    # What a host takes of its processors, and whether there is one, is there for it to read.
    for name in ("stat", "cpuinfo"):
        assert (loop / "root/proc" / name).exists(), name


def shows_itself(_: Any) -> None:
    """The live view runs, and forbids itself more than the unit forbids all."""

    def filters(name: str) -> int:
        status = Path(f"/proc/{ask('status')['pids'][name]}/status").read_text()
        return int(re.findall(r"Seccomp_filters:\s+(\d+)", status)[0])

    until(lambda: filters("live") == filters("supervisor") + 1, "the filter of the live view")
    page = ""

    def answered() -> bool:
        nonlocal page
        with contextlib.suppress(OSError), urllib.request.urlopen(PAGE, timeout=10) as answer:
            page = answer.read().decode()
        return "<html" in page

    until(answered, "the page of the live view")


def flies(_: Any) -> None:
    session = Path("/run/session.yaml")
    session.write_text(SESSION.replace("duration_s: 4", "duration_s: 2"))
    run(*as_user("labuser"), LEVID, "excite", str(session), "--out", str(STATE / "first"))
    assert len(list((STATE / "first").glob("*.mcap"))) == 4
    assert (STATE / "first" / "report").is_dir()


def refuses(_: Any) -> None:
    asked = subprocess.run(
        [*as_user("stranger"), LEVID, "status"], capture_output=True, text=True, check=False
    )
    assert asked.returncode == 1, (asked.stdout, asked.stderr)
    assert "Permission denied" in asked.stderr, asked.stderr
    assert "has no access" in asked.stderr, asked.stderr


def recorder_dies(_: Any) -> None:
    before = lift_off("recorder-dies")
    begun = before["cycle"]
    status_when(lambda s: s["cycle"] > begun + 2 * RATE_HZ)  # something of it is in a file
    os.kill(before["pids"]["recorder"], signal.SIGKILL)
    after = status_when(lambda s: s["recorder_restarts"] > before["recorder_restarts"])
    assert (after["state"], after["fault"]) == ("LEVITATING", "NONE"), after


def clock_steps(_: Any) -> None:
    """Somebody sets the clock, an hour forward and two back, while it flies and records."""
    for by_s, in_all_s in ((3600.0, 3600.0), (-7200.0, -3600.0), (3600.0, 0.0)):
        time.clock_settime(time.CLOCK_REALTIME, time.time() + by_s)
        status_when(lambda s, all_s=in_all_s: abs(s["clock_stepped_s"] - all_s) < 1.0)  # type: ignore[misc]
        begun = ask("status")["cycle"]
        after = status_when(lambda s, begun=begun: s["cycle"] > begun + RATE_HZ)  # type: ignore[misc]
        assert (after["state"], after["fault"]) == ("LEVITATING", "NONE"), after


def loop_dies(electronics: subprocess.Popen[str]) -> None:
    status = ask("status")
    os.kill(status["pids"]["loop"], signal.SIGKILL)
    assert status_when(lambda s: s["fault"] != "NONE")["fault"] == "LOOP"
    no_force(electronics)
    opens("recorder-dies", status["cycle"], parts=2)
    assert ask("clear")["cleared"] == "LOOP"
    assert shown("NRestarts") == "0"
    told("LEVID_FAULT=LOOP", "PRIORITY=3")


def supervisor_dies(electronics: subprocess.Popen[str]) -> None:
    status = lift_off("supervisor-dies")
    os.kill(status["pids"]["supervisor"], signal.SIGKILL)
    restarted(1)
    no_force(electronics)
    opens("supervisor-dies", status["cycle"])
    assert list((STATE / "faults").glob("*-SUPERVISOR.mcap"))


def loop_hangs(electronics: subprocess.Popen[str]) -> None:
    status = lift_off("loop-hangs")
    os.kill(status["pids"]["loop"], signal.SIGSTOP)
    assert status_when(lambda s: s["fault"] != "NONE")["fault"] == "LOOP"
    no_force(electronics)
    opens("loop-hangs", status["cycle"])
    restarted(2)  # nobody clears the fault: the watchdog is no longer fed
    assert "watchdog" in run("journalctl", "--no-pager", "-u", "levid").lower()


def power_cut() -> None:
    """Record until the host, told by a file, ends this guest in the middle of it."""
    subprocess.Popen(
        [LEVID, "excite", "/dev/stdin", "--out", str(STATE / "cut-logs")], stdin=long()
    )
    status = status_when(lambda s: s["state"] == "EXCITING")
    begun = status["cycle"]
    status = status_when(lambda s: s["cycle"] > begun + 5 * RATE_HZ)
    assert status["state"] == "EXCITING", status
    said = {"cycle": status["cycle"], "begun": begun, "rate_hz": RATE_HZ}
    (RESULTS / "exit-code").write_text("0\n")
    (RESULTS / "cut.part").write_text(json.dumps(said))
    (RESULTS / "cut.part").rename(RESULTS / "cut")
    time.sleep(PATIENCE_S)
    sys.exit("the host did not cut the power")


def long() -> Any:
    path = Path("/run/long.yaml")
    path.write_text(LONG)
    return path.open()


def lift_off(log: str) -> dict[str, Any]:
    """Levitate, recording into this folder of the daemon's own.

    Without the check of the coils, which fails in a guest that stands still for a moment.
    """
    status_when(lambda s: s["state"] == "IDLE")
    levitate = {"unload_s": 0.2, "ramp_s": 0.5, "settle_s": 0.2, "check_coils": False}
    ask("levitate", levitate=levitate, out=str(STATE / log))
    return status_when(lambda s: s["state"] == "LEVITATING")


def opens(log: str, cycle: int, parts: int = 1) -> None:
    """Wait until a flight's log opens, in so many parts, up to LOST_S before this cycle.

    Then every cycle that was flown has to be in it, whoever was killed meanwhile.
    """
    found: list[np.ndarray] = []

    def there() -> bool:
        nonlocal found
        try:
            found = [read_log(path).rows for path in (STATE / log).glob("*.mcap")]
        except LogError:  # not a row of it is in the file as yet
            return False
        found.sort(key=lambda rows: int(rows["cycle"][0]))
        return len(found) >= parts and found[-1]["cycle"][-1] >= cycle - LOST_S * RATE_HZ

    def told() -> str:
        return f"{[(len(rows), int(rows['cycle'][-1])) for rows in found]}"

    until(there, f"the log {log} up to cycle {cycle}", told)
    rows = np.concatenate(found)
    counted = rows["skipped"][1:] < MOST_SKIPPED  # of more a row does not know how many
    steps = np.diff(rows["cycle"].astype(np.int64))
    assert (steps == 1 + rows["skipped"][1:])[counted].all(), f"{log}: rows are missing"
    say(f"{log}: {len(found)} parts open, {len(rows)} rows")


def restarted(times: int) -> None:
    """Wait for so many restarts in all; whatever was flown, it rests at IDLE after each."""
    until(lambda: shown("NRestarts") == f"{times}", f"restart {times}")
    until(lambda: shown("ActiveState") == "active", "active again")
    status = ask("status")
    assert (status["state"], status["fault"]) == ("IDLE", "NONE"), status


def no_force(electronics: subprocess.Popen[str]) -> None:
    """Wait until no amplifier drives a force."""

    def forces() -> bool:
        assert electronics.stdin is not None
        assert electronics.stdout is not None
        electronics.stdin.write("status\n")
        electronics.stdin.flush()
        while not (answer := electronics.stdout.readline()).strip():
            assert electronics.poll() is None, "the electronics ended"
        return any(yaml.safe_load(answer)["acting_n"])

    until(lambda: not forces(), "zero force")


def told(*fields: str) -> None:
    run("journalctl", "--flush")
    found = run("journalctl", "--no-pager", "-o", "json", *fields)
    assert found.strip(), f"nothing in the journal with {fields}"


def ask(op: str, **more: Any) -> dict[str, Any]:
    with Client(Path("/run/levid/levid.sock")) as client:
        return client.request(op, **more)


def status_when(condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    found: dict[str, Any] = {}

    def fulfilled() -> bool:
        nonlocal found
        try:
            found = ask("status")
        except DaemonError:
            return False
        return condition(found)

    until(fulfilled, "a status", lambda: found)
    return found


def until(
    condition: Callable[[], bool], what: str, otherwise: Callable[[], object] = lambda: ""
) -> None:
    give_up_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < give_up_s, f"waited in vain for {what}: {otherwise()}"
        time.sleep(0.1)


def shown(name: str) -> str:
    return run("systemctl", "show", "--value", "-p", name, "levid").strip()


def as_user(name: str) -> list[str]:
    who = pwd.getpwnam(name)
    uid, gid = f"{who.pw_uid}", f"{who.pw_gid}"
    return ["setpriv", "--reuid", uid, "--regid", gid, "--init-groups"]


def run(*command: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, (command, done.stdout[-2000:], done.stderr[-2000:])
    return done.stdout


def say(what: str) -> None:
    with (RESULTS / "report.txt").open("a") as report:
        report.write(f"{time.monotonic() - BEGAN_S:5.1f} s  {what.replace('_', ' ')}\n")


if __name__ == "__main__":
    main()
