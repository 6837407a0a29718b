"""Measure a call in a process of its own: a hang, a crash or too much memory is a result too."""

from __future__ import annotations

import importlib
import multiprocessing as mp
import os
import resource
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any

from levid.daemon.host.real_time_scheduling import signal_at_parent_death

_ENDING_S = 30.0


@dataclass(frozen=True)
class Outcome:
    """Value and cost of a call, or why it failed.

    `seconds`: wall time of the call, without starting Python and importing. `peak_bytes`: largest
    resident size of its process, or of a program that it ran, Python included.
    """

    value: Any = None
    seconds: float = 0.0
    peak_bytes: int = 0
    failed: str = ""


def measure_apart(
    call: Callable[..., Any],
    *arguments: object,
    packages: Sequence[str] = (),
    timeout_s: float,
    memory_bytes: int,
) -> Outcome:
    """Return the outcome of call(*arguments) in a new process with limits of time and memory.

    The memory limit is one of address space, which includes reserved memory, for each process.
    Programs that the call runs end with it. `packages` are imported before the clock starts. Call
    and arguments must pickle.
    """
    context = mp.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(
        target=_run, args=(theirs, memory_bytes, tuple(packages), call, arguments)
    )
    process.start()
    theirs.close()
    try:
        if not ours.poll(timeout_s):
            return Outcome(failed=f"not done after {timeout_s:g} s")
        outcome = ours.recv()
        assert isinstance(outcome, Outcome)
        return outcome
    except EOFError:  # it has died
        wait([process.sentinel], _ENDING_S)
    finally:
        assert process.pid is not None
        # Until the process is reaped, its number is not given to another one.
        with suppress(ProcessLookupError):  # it has no session of its own yet
            os.killpg(process.pid, signal.SIGKILL)
        process.kill()
        process.join(_ENDING_S)
    code = process.exitcode or 0
    how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"ended with code {code}"
    return Outcome(failed=how)


def _run(
    pipe: Connection,
    memory_bytes: int,
    packages: tuple[str, ...],
    call: Callable[..., Any],
    arguments: tuple[object, ...],
) -> None:
    os.setsid()
    signal_at_parent_death(os.getppid(), signal.SIGKILL)
    resource.setrlimit(resource.RLIMIT_AS, (memory_bytes, memory_bytes))
    sys.stdout = sys.stderr  # prints of a peer must not be in the JSON
    try:
        for package in packages:
            importlib.import_module(package)
        start = time.perf_counter()
        value = call(*arguments)
        seconds = time.perf_counter() - start
    except ModuleNotFoundError as error:
        outcome = Outcome(failed=f"{error.name} is not installed")
    except MemoryError:
        outcome = Outcome(failed=f"more than {memory_bytes / 1e9:.0f} GB of address space")
    except Exception as error:  # noqa: BLE001 - any error of a peer is its result
        first = (str(error).splitlines() or [""])[0]
        outcome = Outcome(failed=f"{type(error).__name__}: {first}"[:120])
    else:
        outcome = Outcome(value, seconds, _peak_bytes())
    pipe.send(outcome)
    pipe.close()


def _peak_bytes() -> int:
    who = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * max(resource.getrusage(w).ru_maxrss for w in who)
