"""The witness of the machine's punctuality: what it sees, what it does not, and when it ends."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from scheduling_delay import PERIOD_S, Watch, Witness

HELD_UP_S = 0.3
GIVE_UP_S = 30.0


@pytest.mark.real_time
def test_whatever_holds_this_process_up_is_no_lack_of_time(witness: Witness) -> None:
    watch = Watch(witness)
    # A call that keeps Python's lock: no thread of this process runs meanwhile.
    ctypes.PyDLL(None).usleep(round(1e6 * HELD_UP_S))
    assert watch.starved == ""


def test_a_witness_that_gets_no_time_says_so() -> None:
    witness = Witness()
    watch = Watch(witness)
    os.kill(witness.pid, signal.SIGSTOP)
    time.sleep(HELD_UP_S)
    os.kill(witness.pid, signal.SIGCONT)
    starved = watch.starved
    witness.close()
    assert "the machine was too busy" in starved


def test_each_question_is_about_what_was_since_the_last() -> None:
    witness = Witness()
    os.kill(witness.pid, signal.SIGSTOP)
    time.sleep(HELD_UP_S)
    os.kill(witness.pid, signal.SIGCONT)
    first = witness.asked()
    second = witness.asked()
    witness.close()
    assert first.worst_s > HELD_UP_S - 2 * PERIOD_S
    assert first.wakes >= 1
    assert second.wakes <= first.wakes + second.late + 1  # nothing is told twice
    assert second.worst_s < first.worst_s


def test_a_witness_that_is_gone_excuses_nothing() -> None:
    witness = Witness()
    watch = Watch(witness)
    os.kill(witness.pid, signal.SIGKILL)
    assert watch.starved == ""
    witness.close()


def test_it_ends_with_the_tests_whatever_ends_them() -> None:
    """Killed outright, and survived by a process that holds the pipe's other end."""
    told = subprocess.run(
        [
            sys.executable,
            "-c",
            "import os, signal, time\n"
            "from scheduling_delay import Witness\n"
            "witness = Witness()\n"
            "heir = os.fork()\n"
            "if not heir:\n"
            "    os.close(1)\n"
            "    time.sleep(60)\n"
            "    os._exit(0)\n"
            "print(witness.pid, heir, flush=True)\n"
            "os.kill(os.getpid(), signal.SIGKILL)\n",
        ],
        cwd=Path(__file__).parent,
        stdout=subprocess.PIPE,
        check=False,
    ).stdout
    witness, heir = map(int, told.split())
    give_up_s = time.monotonic() + GIVE_UP_S
    while running(witness):
        assert time.monotonic() < give_up_s
        time.sleep(PERIOD_S)
    os.kill(heir, signal.SIGKILL)


def running(pid: int) -> bool:
    """Return whether a process still runs; one that nobody has asked after yet does not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"
