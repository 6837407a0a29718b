"""The loop's process: opens the devices, asks the kernel to be punctual, and flies."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..config.rig import RigConfig
from ..drivers.base import Context, Devices
from ..drivers.registry import open_devices
from .board import Board, Word
from .clock import RealClock
from .control import Controller
from .failures import fault_of
from .faults import Fault
from .journal import Journal
from .realtime import be_punctual, call_me, die_with, no_collections
from .shared import Shared
from .states import State
from .timed_loop import TimedLoop
from .warm_up import locate, warm_up

_POLL_S = 0.02


def main(fd: str, parent: str, folder: str) -> None:
    """Run until the board says to end; the rig comes as JSON on standard input."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the supervisor's to answer
    call_me("levid-loop")
    # While devices are being opened a driver may block: then the kernel ends it with its parent.
    die_with(int(parent), signal.SIGTERM)
    rig = RigConfig.model_validate_json(sys.stdin.buffer.read())
    shared = Shared(rig, int(fd))
    board = shared.board
    board[Word.BUSY] = 1
    board[Word.LOOPS] += 1
    controller = Controller(rig, 1.0 / rig.rate_hz, shared.control)
    row = np.zeros(1, shared.dtype)

    def ready(devices: Devices) -> None:
        warm_up(controller, devices, row, rig, _cycle_now(board, rig.rate_hz))

    devices = _opened(rig, Path(folder), board, ready)
    if devices is None:
        return
    try:
        _fly(rig, controller, devices, shared, int(parent))
    finally:
        devices.close()


def _fly(
    rig: RigConfig, controller: Controller, devices: Devices, shared: Shared, parent: int
) -> None:
    board = shared.board
    clock = RealClock(1.0 / rig.rate_hz)

    def recover() -> None:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        try:
            devices.recover()
            # Drives that were off may have been moved by hand: they stay where they are now.
            locate(controller, devices, rig, loop.cycle)
        finally:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)

    journal = Journal()
    loop = TimedLoop(rig, controller, devices, clock, shared, recover, parent)
    for warning in be_punctual(rig.realtime):
        journal.say(f"warning: {warning}")
    journal.close()
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # it sees for itself that its parent is gone
    with no_collections():
        clock.start()
        if not board[Word.EPOCH_NS]:
            board[Word.EPOCH_MONOTONIC_NS] = time.monotonic_ns()
            board[Word.EPOCH_NS] = clock.epoch_ns
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
    rig: RigConfig, folder: Path, board: Board, ready: Callable[[Devices], None]
) -> Devices | None:
    """Open the devices and get `ready`; where that fails, every request to clear tries again."""
    seen = board[Word.CLEAR]
    while True:
        try:
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
        board[Word.BUSY] = 1
        board[Word.ZERO] = 0


if __name__ == "__main__":
    main(*sys.argv[1:])
