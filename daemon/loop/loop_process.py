"""Loop process: open the devices, set real-time scheduling, run the control loop."""

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
from ...drivers.open_backends import open_devices
from ..control.control_cycle import Controller
from ..control.exception_to_fault import fault_of
from ..control.faults import Fault
from ..control.states import State
from ..host.child_process import receive_signals
from ..host.real_time_scheduling import (
    allow_cpus,
    apply_realtime,
    no_collections,
    set_process_name,
    signal_at_parent_death,
)
from ..ipc.shared_memory import SharedMemory, memory_order_warnings
from ..ipc.shared_status_words import ControlWords, Word
from ..service.journal import Journal, moment
from .clock import RealClock
from .prepare_first_cycle import locate, warm_up
from .real_time_loop import TimedLoop

_POLL_S = 0.02
_OPENING_S = 150
"""Time after which the kernel ends a blocked process; the supervisor kills it sooner."""
_CLOSING_S = 5
"""Time limit for closing the devices after their opening was interrupted."""


def main(fd: str, parent: str, folder: str) -> None:
    """Run until the control words request the end; read the rig as JSON from standard input."""
    # Ctrl-C, and a reload signal sent to all processes, are handled by the supervisor.
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    set_process_name("levid-loop")
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    # The kernel also sends SIGTERM when the parent ends: stop opening the devices.
    signal.signal(signal.SIGTERM, _end)
    receive_signals()
    signal_at_parent_death(int(parent), signal.SIGTERM)
    rig = RigConfig.model_validate_json(sys.stdin.buffer.read())
    allow_cpus(rig.realtime.cpus)
    shared = SharedMemory(rig, int(fd))
    control_words = shared.control_words
    control_words[Word.BUSY] = 1
    control_words[Word.LOOPS] += 1
    controller = Controller(rig, 1.0 / rig.rate_hz, shared.control)
    row = np.zeros(1, shared.dtype)
    journal = Journal()
    journal.fields = lambda: moment(rig.name, control_words)

    def ready(devices: Devices) -> None:
        warm_up(controller, devices, row, rig, _cycle_now(control_words, rig.rate_hz))

    try:
        devices = _opened(rig, Path(folder), control_words, ready, journal.log)
        if devices is None:
            journal.close()
            return
        try:
            _fly(rig, controller, devices, shared, int(parent), journal)
        finally:
            devices.close()
    except SystemExit:
        control_words[Word.STATE] = State.OFF
        raise


def _end(*_: object) -> None:
    """Handle SIGTERM while devices are opened or recovered: interrupt that and close them.

    Otherwise drives would continue homing.
    """
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # do not interrupt the closing
    signal.alarm(_CLOSING_S)  # the kernel ends the process if closing blocks
    raise SystemExit(128 + signal.SIGTERM)


@contextlib.contextmanager
def _bounded() -> Iterator[None]:
    """Have the kernel end this process if a driver blocks forever and ignores signals."""
    signal.alarm(_OPENING_S)
    try:
        yield
    finally:
        # After SIGTERM, the alarm of `_end` stays.
        if signal.getsignal(signal.SIGTERM) is not signal.SIG_IGN:
            signal.alarm(0)


def _fly(
    rig: RigConfig,
    controller: Controller,
    devices: Devices,
    shared: SharedMemory,
    parent: int,
    journal: Journal,
) -> None:
    control_words = shared.control_words
    clock = RealClock(1.0 / rig.rate_hz)

    def recover() -> None:
        signal.signal(signal.SIGTERM, _end)
        try:
            with _bounded():
                devices.recover()
                # Drives may have been moved by hand while off: hold them at their present position.
                locate(controller, devices, rig, loop.cycle)
        finally:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)

    loop = TimedLoop(rig, controller, devices, clock, shared, recover, parent)
    for warning in (*memory_order_warnings(), *apply_realtime(rig.realtime)):
        journal.log(f"warning: {warning}")
    journal.close()
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # the loop itself detects the parent's end
    with no_collections():
        clock.start()
        if not control_words[Word.EPOCH_NS]:
            control_words[Word.EPOCH_MONOTONIC_NS] = time.monotonic_ns()
            control_words[Word.EPOCH_NS] = clock.epoch_ns
            since_ns = (
                control_words[Word.EPOCH_MONOTONIC_NS] - control_words[Word.HEAT_MONOTONIC_NS]
            )
            controller.cool(1e-9 * since_ns)  # no cycles while devices were opened
        loop.cycle = _cycle_now(control_words, rig.rate_hz)
        control_words[Word.BUSY] = 0
        loop.run()


def _cycle_now(control_words: ControlWords, rate_hz: float) -> int:
    """Return the number of the current period; a restarted loop continues the count."""
    if not control_words[Word.EPOCH_NS]:
        return -1
    passed_ns = time.monotonic_ns() - control_words[Word.EPOCH_MONOTONIC_NS]
    return int(passed_ns * 1e-9 * rate_hz)


def _opened(
    rig: RigConfig,
    folder: Path,
    control_words: ControlWords,
    ready: Callable[[Devices], None],
    log: Callable[[str], None],
) -> Devices | None:
    """Open the devices and call `ready`; after a failure, retry at each request to clear.

    Return None if the end is requested first.
    """
    request = control_words[Word.CLEAR]
    while True:
        try:
            with _bounded():
                devices = open_devices(Context(rig, 1.0 / rig.rate_hz, folder))
                try:
                    ready(devices)
                except BaseException:
                    devices.close()
                    raise
        except Exception as error:  # noqa: BLE001 - becomes a fault; the next try clears it
            fault, detail = fault_of(error)
            control_words.detail = detail
            control_words[Word.FAULT], control_words[Word.STATE] = fault, State.FAULT
            log(f"no flight recording of {fault.name}: it occurred while devices were opened")
            control_words[Word.CLEARED] = request
            control_words[Word.BUSY] = 0
        else:
            control_words[Word.STATE] = (
                State.OFF
            )  # the request to clear is answered after the self-test
            control_words[Word.FAULT] = Fault.NONE
            control_words.detail = ""
            control_words[Word.CLEARED] = request
            return devices
        while control_words[Word.CLEAR] == request:
            if control_words[Word.END]:
                control_words[Word.STATE] = State.OFF
                return None
            control_words[Word.WAITING] += 1
            time.sleep(_POLL_S)
        request = control_words[Word.CLEAR]
        control_words.cancel_stop()  # an earlier stop; later ones apply
        control_words[Word.BUSY] = 1


if __name__ == "__main__":
    main(*sys.argv[1:])
