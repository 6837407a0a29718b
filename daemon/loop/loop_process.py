"""The loop's process: opens the devices, asks the kernel to be punctual, and flies."""

from __future__ import annotations

import contextlib
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from ...config.rig import RigConfig
from ...drivers.base import Context, Devices
from ...drivers.registry import open_devices
from ..control.control_cycle import Controller
from ..control.exception_faults import fault_of
from ..control.faults import Fault
from ..control.states import State
from ..host.real_time_scheduling import (
    be_punctual,
    call_me,
    die_with,
    no_collections,
    share_with_others,
)
from ..ipc.control_words import Board, Word
from ..ipc.shared_memory import Shared, doubts_of_order
from ..service.journal import Journal, moment
from .clock import RealClock
from .real_time_loop import TimedLoop
from .warm_up import locate, warm_up

_POLL_S = 0.02
_OPENING_S = 150
"""When the kernel ends a process whose driver blocks; the supervisor, if there is one, is first."""
_CLOSING_S = 5
"""How long stopping the devices may take where opening them was ended."""


def main(fd: str, parent: str, folder: str) -> None:
    """Run until the board says to end; the rig comes as JSON on standard input."""
    # Ctrl-C, and a reload that is sent to every process, are the supervisor's to answer.
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    call_me("levid-loop")
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    # The kernel sends it with the parent's end, too: what was begun with devices is to be stopped.
    signal.signal(signal.SIGTERM, _end)
    die_with(int(parent), signal.SIGTERM)
    rig = RigConfig.model_validate_json(sys.stdin.buffer.read())
    share_with_others(rig.realtime.cpus)
    shared = Shared(rig, int(fd))
    board = shared.board
    board[Word.BUSY] = 1
    board[Word.LOOPS] += 1
    controller = Controller(rig, 1.0 / rig.rate_hz, shared.control)
    row = np.zeros(1, shared.dtype)
    journal = Journal()
    journal.fields = lambda: moment(rig.name, board)

    def ready(devices: Devices) -> None:
        warm_up(controller, devices, row, rig, _cycle_now(board, rig.rate_hz))

    try:
        devices = _opened(rig, Path(folder), board, ready, journal.say)
        if devices is None:
            journal.close()
            return
        try:
            _fly(rig, controller, devices, shared, int(parent), journal)
        finally:
            devices.close()
    except SystemExit:
        board[Word.STATE] = State.OFF
        raise


def _end(*_: object) -> None:
    """Answer SIGTERM while devices are opened or recovered: end what blocks, and close them.

    Drives that are being homed would go on.
    """
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # once: nothing is to end the closing
    signal.alarm(_CLOSING_S)  # but the kernel, which asks no driver
    raise SystemExit(128 + signal.SIGTERM)


@contextlib.contextmanager
def _bounded() -> Iterator[None]:
    """Have the kernel end this process where a driver blocks for good, deaf to signals."""
    signal.alarm(_OPENING_S)
    try:
        yield
    finally:
        # Where it is ended, `_end` has set an alarm of its own.
        if signal.getsignal(signal.SIGTERM) is not signal.SIG_IGN:
            signal.alarm(0)


def _fly(
    rig: RigConfig,
    controller: Controller,
    devices: Devices,
    shared: Shared,
    parent: int,
    journal: Journal,
) -> None:
    board = shared.board
    clock = RealClock(1.0 / rig.rate_hz)

    def recover() -> None:
        signal.signal(signal.SIGTERM, _end)
        try:
            with _bounded():
                devices.recover()
                # Drives that were off may have been moved by hand: they stay where they are now.
                locate(controller, devices, rig, loop.cycle)
        finally:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)

    loop = TimedLoop(rig, controller, devices, clock, shared, recover, parent)
    for warning in (*doubts_of_order(), *be_punctual(rig.realtime)):
        journal.say(f"warning: {warning}")
    journal.close()
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # it sees for itself that its parent is gone
    with no_collections():
        clock.start()
        if not board[Word.EPOCH_NS]:
            board[Word.EPOCH_MONOTONIC_NS] = time.monotonic_ns()
            board[Word.EPOCH_NS] = clock.epoch_ns
            since_ns = board[Word.EPOCH_MONOTONIC_NS] - board[Word.HEAT_MONOTONIC_NS]
            controller.cool(1e-9 * since_ns)  # while devices were opened there were no cycles
        loop.cycle = _cycle_now(board, rig.rate_hz)
        board[Word.BUSY] = 0
        loop.run()


def _cycle_now(board: Board, rate_hz: float) -> int:
    """Return the number of the period at hand; a loop that follows a dead one counts on."""
    if not board[Word.EPOCH_NS]:
        return -1
    passed_ns = time.monotonic_ns() - board[Word.EPOCH_MONOTONIC_NS]
    return int(passed_ns * 1e-9 * rate_hz)


def _opened(
    rig: RigConfig,
    folder: Path,
    board: Board,
    ready: Callable[[Devices], None],
    say: Callable[[str], None],
) -> Devices | None:
    """Open the devices and get `ready`; where that fails, every request to clear tries again."""
    seen = board[Word.CLEAR]
    while True:
        try:
            with _bounded():
                devices = open_devices(Context(rig, 1.0 / rig.rate_hz, folder))
                try:
                    ready(devices)
                except BaseException:
                    devices.close()
                    raise
        except Exception as error:  # noqa: BLE001 - the fault is told, and is cleared by the next try
            fault, detail = fault_of(error)
            board.detail = detail
            board[Word.FAULT], board[Word.STATE] = fault, State.FAULT
            say(f"no flight recording of {fault.name}: it came as devices were opened")
            board[Word.CLEARED] = seen
            board[Word.BUSY] = 0
        else:
            board[Word.STATE] = State.OFF  # whoever cleared is answered after the self-test
            board[Word.FAULT] = Fault.NONE
            board.detail = ""
            board[Word.CLEARED] = seen
            return devices
        while board[Word.CLEAR] == seen:
            if board[Word.END]:
                board[Word.STATE] = State.OFF
                return None
            board[Word.WAITING] += 1
            time.sleep(_POLL_S)
        seen = board[Word.CLEAR]
        board.take_back_stop()  # of before: what comes from then on ends what is begun here
        board[Word.BUSY] = 1


if __name__ == "__main__":
    main(*sys.argv[1:])
