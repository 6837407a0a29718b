"""Test that only what a device reported becomes a device fault."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from functools import partial
from types import ModuleType

import can
import numpy as np
import pytest
import serial

from levid.config.base import ConfigError
from levid.daemon.control.exception_to_fault import fault_of
from levid.daemon.control.faults import FAULTS, Fault
from levid.drivers.base import DriverError, LinkError

CALLS = """
def call(function):
    function()
"""


def module(name: str) -> ModuleType:
    """Return a module whose `call` is in the traceback of what it calls."""
    made = ModuleType(name)
    exec(compile(CALLS, name, "exec"), vars(made))
    return made


def raised(function: Callable[[], object], *through: str) -> Exception:
    """Return what a function raises that modules of these names call, the first one first."""
    for name in reversed(through):
        function = partial(module(name).call, function)  # which adds no frame of its own
    with pytest.raises(Exception) as caught:  # noqa: PT011 - any
        function()
    # The frames of this test itself are those of a package that is no part of levid.
    error = caught.value
    traceback = error.__traceback__
    while traceback and traceback.tb_frame.f_globals["__name__"] != through[0]:
        traceback = traceback.tb_next
    return error.with_traceback(traceback)


def thrower(error: Exception) -> Callable[[], None]:
    """Return a function that raises, in a frame of the standard library's name."""
    made = ModuleType("selectors")
    exec("def throw(error):\n    raise error", vars(made))
    return partial(made.throw, error)


LOOP, DRIVER, PLUGIN = "levid.daemon.loop.real_time_loop", "levid.drivers.can.backend", "acme.rig"


class AcmeError(Exception):
    """An error of another company's library."""


AcmeError.__module__ = "acme.bus"


@pytest.mark.parametrize(
    "error",
    [
        EOFError("Ran out of input"),  # of an empty cache file
        pickle.UnpicklingError("invalid load key"),
        MemoryError(),
        ImportError("no numba"),
        AttributeError("x"),
        TypeError("x"),
        KeyError("x"),
        ValueError("x"),
        AssertionError(),
        RecursionError(),
        ZeroDivisionError(),
        RuntimeError("no compiled object yet"),
        UnicodeDecodeError("utf-8", b"", 0, 1, "x"),
        np.linalg.LinAlgError("singular"),
    ],
    ids=lambda error: type(error).__name__,
)
@pytest.mark.parametrize("through", [(LOOP,), (LOOP, DRIVER), (LOOP, PLUGIN)], ids=str)
def test_error_of_software_is_no_device_s(error: Exception, through: tuple[str, ...]) -> None:
    fault, detail = fault_of(raised(thrower(error), *through))
    assert fault is Fault.SOFTWARE
    assert type(error).__name__ in detail
    assert "cable" not in FAULTS[fault].check


@pytest.mark.parametrize(
    "through", [(LOOP,), (LOOP, "levid.daemon.control.control_cycle"), (LOOP, DRIVER, "numba.core")]
)
def test_full_disk_or_missing_file_of_the_software_is_no_device_s(through: tuple[str, ...]) -> None:
    for error in (OSError(28, "No space left on device"), FileNotFoundError(2, "No such file")):
        assert fault_of(raised(thrower(error), *through))[0] is Fault.SOFTWARE


@pytest.mark.parametrize(
    ("error", "through"),
    [
        (OSError(5, "Input/output error"), (LOOP, PLUGIN)),
        (TimeoutError("no answer"), (LOOP, PLUGIN)),
        (ConnectionResetError("gone"), (LOOP, DRIVER)),
        (OSError(19, "No such device"), (LOOP, DRIVER, "levid.wire.can.can_bus")),
        (AcmeError("supply"), (LOOP, PLUGIN)),
        (can.CanOperationError("bus"), (LOOP, PLUGIN)),
        (serial.SerialException("port"), (LOOP, PLUGIN)),
        (DriverError("supply"), (LOOP,)),
    ],
    ids=lambda value: type(value).__name__,
)
def test_error_that_a_backend_lets_through_is_the_device_s(
    error: Exception, through: tuple[str, ...]
) -> None:
    assert fault_of(raised(thrower(error), *through))[0] is Fault.DRIVER


def test_named_errors_keep_their_faults() -> None:
    assert fault_of(LinkError("can0: lost")) == (Fault.LINK, "can0: lost")
    assert fault_of(ConfigError("SIM.yaml: x")) == (Fault.SIMULATION, "SIM.yaml: x")


def test_error_without_a_traceback_is_software_s() -> None:
    assert fault_of(OSError(5, "x"))[0] is Fault.SOFTWARE
