"""What two loops that want one bus are told."""

from __future__ import annotations

import os
import pwd

import pytest

from levid.drivers.base import LinkError
from levid.drivers.can.bus_link import CanLink
from levid.drivers.serial.serial_line import SerialLine


def is_for_one_loop(first: CanLink | SerialLine, second: CanLink | SerialLine) -> None:
    """Assert that the second opens once the first is closed, and no sooner."""
    first.open()
    user = pwd.getpwuid(os.geteuid()).pw_name
    with pytest.raises(LinkError, match=rf"another loop.*process {os.getpid()} .*user {user};"):
        second.open()
    first.open()  # anew, as after a fault
    with pytest.raises(LinkError, match="another loop"):
        second.open()
    first.close()
    second.open()
    second.close()
