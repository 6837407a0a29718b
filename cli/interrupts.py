"""End a command at Ctrl-C: exit code 130, no traceback, nothing left that it has not finished.

Python's own handler raises KeyboardInterrupt wherever the command is. That is a traceback while
modules are imported, an ImportError or SystemError where C code replaces the exception, and a
message without an end of the command where Python ignores exceptions, as in `__del__`. The cleanup
of a command is interrupted by the next Ctrl-C. The handlers of this module follow each other:

1. `leave_at_once`, before a command begins: it has nothing to clean up, the process ends.
2. `raise_once`, while it runs: the first Ctrl-C raises KeyboardInterrupt, which cleans up. It is
   raised again where Python ignored it. Another one after `_CLEANUP_S` ends the process.
3. `finishing`, after it: the rest of Python's exit has the same time.
4. `_ignore`, last: Python then restores the handler that kills the process.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
import time
from typing import Any

EXIT_INTERRUPTED = 130
_CLEANUP_S = 5.0
"""Time in s for the cleanup after Ctrl-C; later ones end the process at once."""
_AGAIN_S = 0.05
"""Delay in s after which an ignored KeyboardInterrupt is raised again."""


class _State:
    """Handlers of signals get no arguments of their own."""

    interrupted = False
    since_s = 0.0


def leave_at_once() -> None:
    """End the process at Ctrl-C, for as long as there is nothing to clean up."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else nohup or a shell's &
        signal.signal(signal.SIGINT, _end_process)
        atexit.register(_ignore)  # what is registered first runs last


def raise_once() -> None:
    """Raise KeyboardInterrupt at the first Ctrl-C, and again if Python ignored the exception."""
    if signal.getsignal(signal.SIGINT) is _end_process:  # `leave_at_once` was called
        signal.signal(signal.SIGINT, _raise)
        sys.unraisablehook = _unraisable


def finishing() -> None:
    """Let Python's exit finish after the command; a Ctrl-C raises nothing any more."""
    if signal.getsignal(signal.SIGINT) is _raise:
        _wait_for_cleanup()


def interrupted() -> bool:
    """Return whether a Ctrl-C has interrupted the command."""
    return _State.interrupted


def _end_process(*_: object) -> None:
    os.write(2, b"interrupted\n")
    os._exit(EXIT_INTERRUPTED)


def _raise(*_: object) -> None:
    _State.interrupted = True
    _wait_for_cleanup()
    raise KeyboardInterrupt


def _wait_for_cleanup() -> None:
    _State.since_s = time.monotonic()
    signal.signal(signal.SIGINT, _end_late)


def _end_late(*_: object) -> None:
    if time.monotonic() - _State.since_s > _CLEANUP_S:
        _end_process()


def _ignore() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _unraisable(ignored: Any) -> None:
    """Raise a KeyboardInterrupt again that Python has ignored; report other exceptions."""
    if ignored.exc_type is not KeyboardInterrupt:
        sys.__unraisablehook__(ignored)
        return
    signal.signal(signal.SIGINT, _raise)
    again = threading.Timer(_AGAIN_S, os.kill, (os.getpid(), signal.SIGINT))
    again.daemon = True
    again.start()
