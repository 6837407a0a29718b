"""CANopen drives between cycles: objects read and written, limits compared, homed, enabled."""

from __future__ import annotations

import logging
import threading
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter, sleep
from typing import Any

import canopen
from canopen.sdo.base import SdoVariable

from ...config.base import ConfigError
from ...config.shipped import shipped
from ...wire.can.cia402 import (
    DEVICE_TYPE_DRIVE,
    ENABLE_OPERATION,
    EVENT_TIMER,
    HOMING_ATTAINED,
    HOMING_ERROR,
    NMT_ID,
    QUICK_STOP,
    RATED,
    RPDO1_ID,
    RPDO_MAPPING,
    SDO_ANSWER_ID,
    SDO_REQUEST_ID,
    START_HOMING,
    SYNC_COUNTER,
    TARGET_REACHED,
    TOWARDS_OPERATION,
    TPDO1_ID,
    TPDO_MAPPING,
    DriveStates,
    Mode,
    Object,
    state_of,
    write_controlword,
)
from ..base import DriveError, DriverError, LinkError
from .bus_link import CanLink

_STATE_S = 2.0
_LAG_S = 0.1
"""Longer than a statusword lags; who is at home at once, as by method 35 or 37, takes as long."""
_POLL_S = 0.005
_SYNCHRONOUS = 1
_NOT_VALID = 1 << 31
_OPERATIONAL, _PRE_OPERATIONAL = 0x01, 0x80
_SDO_BYTES = 8
_MOST_ANSWERS = 8
"""More answers than an object takes that levid reads or writes, in segments of a byte each."""
_OBJECTS = frozenset(Object)
_OTHER_PDOS = frozenset((*range(0x1401, 0x1600), *range(0x1801, 0x1A00)))


def node_of(node_id: int, eds: Path | None) -> Any:
    """Return the library's node by its EDS, the shipped one for None; raises ConfigError."""
    # The library warns on every object that an EDS leaves out.
    logging.getLogger("canopen").setLevel(logging.ERROR)
    path = eds or shipped("drive.eds")
    try:
        return canopen.RemoteNode(node_id, str(path))
    except Exception as error:  # noqa: BLE001 - the library raises whatever it meets
        raise ConfigError(f"{path}: not a valid EDS: {error}") from None


class DriveNode:
    """One drive, by its EDS; methods wait for its answers, and have to be called within `Answers`.

    `name` is what errors call it. The methods raise DriverError.
    """

    def __init__(self, name: str, node_id: int, eds: Path | None, link: CanLink) -> None:
        self.name, self.node_id = name, node_id
        self.what = f"drive {name} (node {node_id}) on {link.what}"
        self._node = node_of(node_id, eds)
        self._node.sdo.RESPONSE_TIMEOUT = 0.3
        self.counts_syncs = False
        """Whether its SYNC has a counter, which others take for an error; known once configured."""
        self.rated = 1.0
        """Rated force in N, of a rotary motor torque in N m; known once configured."""
        self._started_s: float | None = None  # homing, until that was seen
        self._network = _LinkNetwork(link)
        self._network.add_node(self._node)
        link.listen(SDO_ANSWER_ID + node_id, self._network.notify_now)
        self.link = link

    def configure(
        self,
        limits: dict[tuple[Object, int], int],
        heartbeat_ms: int,
        expire_ms: int,
        sync_s: float,
    ) -> None:
        """Compare limits, set heartbeat and PDOs, which begin with every SYNC from here on.

        `limits`: object and subindex to the value that the rig asks for. `expire_ms`: how long
        targets may stay away, where the drive can watch over that.
        """
        self._nmt(_PRE_OPERATIONAL)
        profile = self._read(Object.DEVICE_TYPE) & 0xFFFF
        if profile != DEVICE_TYPE_DRIVE:
            raise DriverError(f"{self.what}: expected a CiA 402 drive, found profile {profile}")
        wrong = [
            f"{index.name}: expected {expected}, found {found}"
            for (index, sub), expected in limits.items()
            if (found := self._read(index, sub)) != expected
        ]
        if wrong:
            raise DriverError(
                f"{self.what}: limits in the device are not the rig's: {'; '.join(wrong)}"
            )
        self.counts_syncs = self._syncs_are_counted()
        self.rated = RATED * self._read(Object.RATED_FORCE)
        if not self.rated:
            raise DriverError(f"{self.what}: expected a rated force (0x6076), found 0")
        self._write(Object.HEARTBEAT_MS, heartbeat_ms)
        value, power = interpolation(sync_s)
        self._write(Object.INTERPOLATION, value, 1)
        self._write(Object.INTERPOLATION, power, 2)
        rpdo, tpdo = RPDO1_ID + self.node_id, TPDO1_ID + self.node_id
        if self._has(Object.RPDO1, EVENT_TIMER):
            self._write(Object.RPDO1, expire_ms, EVENT_TIMER)
        self._switch_off_other_pdos()
        self._map(Object.RPDO1, Object.RPDO1_MAP, rpdo, RPDO_MAPPING)
        self._map(Object.TPDO1, Object.TPDO1_MAP, tpdo, TPDO_MAPPING)

    def enable(self, homing_method: int) -> None:
        """Reset a fault, and enable operation in homing mode: it stands, and nothing moves yet."""
        self._write(Object.HOMING_METHOD, homing_method)
        self._mode(Mode.HOMING)
        self._go_to_operation()

    def start_homing(self) -> None:
        """Start homing, which takes the rising edge of a bit that may be set from the last time."""
        self._write(Object.CONTROLWORD, ENABLE_OPERATION)
        self._write(Object.CONTROLWORD, START_HOMING)
        self._started_s = perf_counter()

    def homing(self) -> tuple[bool | None, bool]:
        """Return whether positions count from home, and whether the drive stands there.

        A statusword that says so from the first, or that it failed, is believed after a while only:
        it may be one of before the start, of the last time. Until then nobody knows (None).
        """
        word = self._read(Object.STATUSWORD)
        self._require_operation(word)
        if self._started_s is not None:
            told = word & (HOMING_ATTAINED | HOMING_ERROR)
            if told and perf_counter() - self._started_s < _LAG_S:
                return None, False
            self._started_s = None
        if word & HOMING_ERROR:
            raise DriveError(f"{self.what}: homing failed")
        attained = bool(word & HOMING_ATTAINED)
        return attained, attained and bool(word & TARGET_REACHED)

    def follow(self) -> None:
        """Go over to cyclic synchronous position mode, at rest, and exchange PDOs."""
        # Where it stands is the first target: nothing moves when the mode changes.
        self._write(Object.TARGET_POSITION, self._read(Object.ACTUAL_POSITION))
        self._mode(Mode.CYCLIC_SYNCHRONOUS_POSITION)
        self._nmt(_OPERATIONAL)

    def stop(self) -> None:
        """Let the drive brake and switch off, whatever it is doing; no answer is waited for.

        PDOs reach operational nodes alone; one that is being homed, or just started, is none.
        """
        self.link.send(SDO_REQUEST_ID + self.node_id, write_controlword(QUICK_STOP))

    def position(self) -> int:
        """Return the actual position in counts."""
        return self._read(Object.ACTUAL_POSITION)

    def listen(self, waits: bool) -> None:
        """Hand answers to the library only while somebody `waits`: else it would keep them all."""
        self._network.waits = waits

    def _syncs_are_counted(self) -> bool:
        """Return what object 0x1019 says, which drives take at their start only: it is not set."""
        overflow = self._read(Object.SYNC_OVERFLOW) if self._has(Object.SYNC_OVERFLOW) else 0
        if overflow not in (0, SYNC_COUNTER):
            raise DriverError(
                f"{self.what}: SYNC_OVERFLOW (0x1019): expected {SYNC_COUNTER}, or 0 for a SYNC "
                f"that is not counted, found {overflow}"
            )
        return overflow == SYNC_COUNTER

    def _go_to_operation(self) -> None:
        give_up_s = perf_counter() + _STATE_S
        while True:
            state = state_of(self._read(Object.STATUSWORD))
            if state is DriveStates.OPERATION_ENABLED:
                return
            if perf_counter() > give_up_s:
                self._require_operation(self._read(Object.STATUSWORD))
                return
            if state is DriveStates.FAULT:
                self._write(Object.CONTROLWORD, 0)  # the reset takes a rising edge
            if state in TOWARDS_OPERATION:
                self._write(Object.CONTROLWORD, TOWARDS_OPERATION[state])
            sleep(_POLL_S)

    def _require_operation(self, word: int) -> None:
        """Raise DriveError, with the drive's error code, where it is not enabled."""
        state = state_of(word)
        if state is not DriveStates.OPERATION_ENABLED:
            code = self._read(Object.ERROR_CODE)
            words = state.words if state else "in an unknown state"
            raise DriveError(
                f"{self.what}: expected operation enabled, found {words}, error code 0x{code:04X}"
            )

    def _mode(self, mode: Mode) -> None:
        self._write(Object.MODE, mode)
        give_up_s = perf_counter() + _STATE_S
        while self._read(Object.MODE_DISPLAY) != mode:
            if perf_counter() > give_up_s:
                raise DriveError(f"{self.what}: does not change to mode {mode.name}")
            sleep(_POLL_S)

    def _switch_off_other_pdos(self) -> None:
        """Make those invalid that nobody listens or sends to: many drives come with some valid.

        They would fill the bus beside what a cycle is computed to take, or move the drive.
        """
        for index in self._node.object_dictionary:
            if index in _OTHER_PDOS and self._has(index, 1):
                cob_id = self._read(index, 1)
                if not cob_id & _NOT_VALID:
                    self._write(index, cob_id | _NOT_VALID, 1)

    def _map(
        self, record: Object, mapping: Object, cob_id: int, objects: tuple[tuple[Object, int], ...]
    ) -> None:
        """Map a PDO by the procedure of CiA 301: invalid, emptied, filled, valid."""
        self._write(record, cob_id | _NOT_VALID, 1)
        self._write(record, _SYNCHRONOUS, 2)
        self._write(mapping, 0, 0)
        for i, (index, bits) in enumerate(objects, start=1):
            self._write(mapping, index << 16 | bits, i)
        self._write(mapping, len(objects), 0)
        self._write(record, cob_id, 1)

    def _read(self, index: int, sub: int = 0) -> int:
        return int(self._sdo(lambda: self._object(index, sub).raw, index))

    def _write(self, index: int, value: int, sub: int = 0) -> None:
        def write() -> None:
            self._object(index, sub).raw = value

        self._sdo(write, index)

    def _has(self, index: int, sub: int = 0) -> bool:
        """Return whether the EDS has an object."""
        found = self._node.object_dictionary.get(int(index))
        return found is not None and (not sub or sub in found)

    def _object(self, index: int, sub: int) -> Any:
        found = self._node.sdo[int(index)]
        return found if isinstance(found, SdoVariable) else found[sub]

    def _sdo(self, action: Any, index: int) -> Any:
        self._network.answers = 0
        try:
            return action()
        except DriverError:
            raise
        except canopen.SdoCommunicationError as error:
            raise LinkError(f"{self.what}: {_name(index)}: {error}") from None
        except Exception as error:  # noqa: BLE001 - an object that the EDS or the drive lacks
            raise DriverError(f"{self.what}: {_name(index)}: {error}") from None

    def _nmt(self, command: int) -> None:
        self.link.send(NMT_ID, bytes((command, self.node_id)))


def _name(index: int) -> str:
    return Object(index).name if index in _OBJECTS else f"0x{index:04X}"


class _LinkNetwork(canopen.Network):
    """The library on a link: it sends there, and is told what its node answers."""

    def __init__(self, link: CanLink) -> None:
        super().__init__()
        self._link, self.waits = link, False
        self.answers = 0
        """How many came since the last question."""

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:  # noqa: ARG002
        self._link.send(can_id, bytes(data))

    def notify_now(self, can_id: int, data: bytes) -> None:
        """Hand an answer to the library, if somebody waits for it.

        The library looks at no length, and reads segments for as long as a drive sends any.
        """
        if self.waits and len(data) == _SDO_BYTES and self.answers < _MOST_ANSWERS:
            self.answers += 1
            self.notify(can_id, bytearray(data), 0.0)


class Answers:
    """Receives in a thread while the library waits for answers of nodes; between cycles only."""

    def __init__(self, nodes: Sequence[DriveNode]) -> None:
        self._nodes, self._stop = nodes, threading.Event()
        self._thread = threading.Thread(target=self._run, name="levid-sdo", daemon=True)

    def __enter__(self) -> None:
        for node in self._nodes:
            node.listen(True)
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        for node in self._nodes:
            node.listen(False)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._nodes[0].link.receive(perf_counter() + 0.01)
            except DriverError:  # whoever waits for an answer gets a timeout
                return


def interpolation(sync_s: float) -> tuple[int, int]:
    """Return value and power of ten of the interpolation period (object 0x60C2), the nearest."""
    each = [(min(max(round(sync_s / 10.0**p), 1), 255), p) for p in (-3, -4, -5, -6)]
    # The first of those that are as near: what rounding leaves of 1 ms in us is no error.
    return min(each, key=lambda it: round(abs(it[0] * 10.0 ** it[1] - sync_s), 12))
