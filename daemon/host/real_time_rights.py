"""Ask the kernel whether a process of this user would get real-time settings."""

from __future__ import annotations

import json
import os

from ...config.daemon_settings import Realtime
from .real_time_scheduling import apply_realtime


def real_time_rights(settings: Realtime) -> list[str]:
    """Return a warning for each setting of the loop that the kernel refuses this user.

    A child process tries them, and ends.
    """
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.close(read)
            os.write(write, json.dumps(apply_realtime(settings)).encode())
        finally:
            os._exit(0)
    os.close(write)
    with os.fdopen(read, "rb") as answer:
        text = answer.read()
    os.waitpid(child, 0)
    return [str(line) for line in json.loads(text)] if text else []
