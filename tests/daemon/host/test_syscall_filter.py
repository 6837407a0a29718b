"""Test what a confined process can still do, by asking the kernel in a process of its own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = """
import mmap, os, pathlib, resource, signal, socket, sys, threading
from levid.daemon.host.process_confinement import Confinement, confine, lower_priority
from levid.daemon.host.syscall_filter import forbid_syscalls

def refused(name, action):
    try:
        action()
    except OSError as error:
        print(name, type(error).__name__)
    else:
        print(name, "works")

fd = os.memfd_create("memory", os.MFD_CLOEXEC)
os.ftruncate(fd, 4096)
os.fchmod(fd, 0o600)
read_only = os.open(f"/proc/self/fd/{fd}", os.O_RDONLY)
shared = mmap.mmap(read_only, 4096, prot=mmap.PROT_READ)
os.close(fd)
end, other = socket.socketpair()
server = socket.create_server(("127.0.0.1", 0))
waiting = threading.Event()
thread = threading.Thread(target=waiting.wait)
thread.start()
lower_priority(19)
confine(Confinement(None, 1 << 30, 1 << 20, keeps_user=True), [read_only, end.fileno(),
        other.fileno(), server.fileno()])
assert forbid_syscalls() == ""
refused("map", lambda: mmap.mmap(read_only, 4096))
refused("reopen", lambda: os.open(f"/proc/self/fd/{read_only}", os.O_RDWR))
refused("write", lambda: open("FOLDER/new", "w"))
refused("create", lambda: os.open("FOLDER/new", os.O_RDONLY | os.O_CREAT))
refused("unlink", lambda: os.unlink("FOLDER/old"))
refused("rename", lambda: os.rename("FOLDER/old", "FOLDER/other"))
refused("chmod", lambda: os.chmod("FOLDER/old", 0o777))
refused("kill", lambda: os.kill(os.getppid(), 0))
refused("memory of others", lambda: os.open(f"/proc/{os.getppid()}/mem", os.O_RDWR))
refused("affinity", lambda: os.sched_setaffinity(os.getppid(), [0]))
refused("priority", lambda: os.setpriority(os.PRIO_PROCESS, os.getppid(), 19))
refused("limits of others", lambda: resource.prlimit(os.getppid(), resource.RLIMIT_CORE))
refused("own limits", lambda: resource.getrlimit(resource.RLIMIT_CORE))
refused("fork", os.fork)
refused("execute", lambda: os.execv("/bin/true", ["true"]))
refused("local socket", lambda: socket.socket(socket.AF_UNIX))
refused("listen", lambda: socket.create_server(("127.0.0.1", 0)))
refused("connect", lambda: socket.create_connection(server.getsockname()))
refused("read", lambda: open("FOLDER/old").read())
refused("send", lambda: (other.send(b"x"), end.recv(1)))
waiting.set()
thread.join()
print("nice", os.getpriority(os.PRIO_PROCESS, 0))
print("seccomp", *{pathlib.Path(f"/proc/self/task/{t}/status").read_text().partition("Seccomp:")[2]
      .split()[0] for t in os.listdir("/proc/self/task")})
"""


@pytest.fixture(scope="module")
def printed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder: Path = tmp_path_factory.mktemp("files")
    (folder / "old").write_text("old")
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT.replace("FOLDER", str(folder))],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert [path.name for path in folder.iterdir()] == ["old"]
    assert (folder / "old").read_text() == "old"
    return dict(line.rsplit(" ", 1) for line in done.stdout.splitlines())


@pytest.mark.parametrize(
    "action",
    [
        *("map", "reopen", "memory of others", "write", "create", "unlink", "rename", "chmod"),
        *("kill", "affinity", "priority", "limits of others"),
        *("fork", "execute", "local socket", "listen"),
    ],
)
def test_is_refused(printed: dict[str, str], action: str) -> None:
    assert printed[action] == "PermissionError"


@pytest.mark.parametrize("action", ["read", "send", "connect", "own limits"])
def test_still_works(printed: dict[str, str], action: str) -> None:
    assert printed[action] == "works"


def test_every_thread_is_filtered_at_the_lowest_priority(printed: dict[str, str]) -> None:
    assert printed["seccomp"] == "2"
    assert printed["nice"] == "19"
