"""Configure, home and enable a CANopen drive by SDO, between cycles."""

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
"""Longest lag of a statusword in s; homing takes at least that long."""
_POLL_S = 0.005
_SYNCHRONOUS = 1
_NOT_VALID = 1 << 31
_OPERATIONAL, _PRE_OPERATIONAL = 0x01, 0x80
_SDO_BYTES = 8
_MOST_ANSWERS = 8
"""Most SDO answers to one request; objects that levid uses need fewer, at one byte per segment."""
_OBJECTS = frozenset(Object)
_OTHER_PDOS = frozenset((*range(0x1401, 0x1600), *range(0x1801, 0x1A00)))


def node_of(node_id: int, eds: Path | None) -> Any:
    """Return the canopen node of an EDS, by default the shipped one; raises ConfigError."""
    # canopen warns about every object that an EDS omits.
    logging.getLogger("canopen").setLevel(logging.ERROR)
    path = eds or shipped("drive.eds")
    try:
        return canopen.RemoteNode(node_id, str(path))
    except Exception as error:  # noqa: BLE001 - canopen raises any exception
        raise ConfigError(f"{path}: not a valid EDS: {error}") from None


class DriveNode:
    """One drive with its EDS. Methods wait for SDO answers: call them within `Answers`.

    `name` names the drive in errors. The methods raise DriverError.
    """

    def __init__(self, name: str, node_id: int, eds: Path | None, link: CanLink) -> None:
        self.name, self.node_id = name, node_id
        self.what = f"drive {name} (node {node_id}) on {link.what}"
        self._node = node_of(node_id, eds)
        self._node.sdo.RESPONSE_TIMEOUT = 0.3
        self.counts_syncs = False
        """Whether the drive expects a counter in SYNC; valid after `configure`."""
        self.rated = 1.0
        """Rated force in N, for a rotary motor torque in N m; valid after `configure`."""
        self._started_s: float | None = None  # homing
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
        """Compare limits, set the heartbeat, map the PDOs.

        `limits`: the rig's value of each (object, subindex). `expire_ms`: longest time without
        targets, set if the drive has the object for it.
        """
        self._nmt(_PRE_OPERATIONAL)
        profile = self._read(Object.DEVICE_TYPE) & 0xFFFF
        if profile != DEVICE_TYPE_DRIVE:
            raise DriverError(f"{self.what}: expected device profile 402, found {profile}")
        wrong = [
            f"{index.name}: expected {expected}, found {found}"
            for (index, sub), expected in limits.items()
            if (found := self._read(index, sub)) != expected
        ]
        if wrong:
            raise DriverError(
                f"{self.what}: limits of the device differ from RIG.yaml: {'; '.join(wrong)}"
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
        """Reset a fault and enable operation in homing mode, without moving."""
        self._write(Object.HOMING_METHOD, homing_method)
        self._mode(Mode.HOMING)
        self._go_to_operation()

    def start_homing(self) -> None:
        """Start homing, by a rising edge of its bit in the controlword."""
        self._write(Object.CONTROLWORD, ENABLE_OPERATION)
        self._write(Object.CONTROLWORD, START_HOMING)
        self._started_s = perf_counter()

    def homing(self) -> tuple[bool | None, bool]:
        """Return whether home is attained (None: not known yet), and whether the drive rests there.

        The statusword may still show the result of the previous homing: in the first _LAG_S after
        the start, a result is ignored.
        """
        word = self._read(Object.STATUSWORD)
        self._require_operation(word)
        if self._started_s is not None:
            result = word & (HOMING_ATTAINED | HOMING_ERROR)
            if result and perf_counter() - self._started_s < _LAG_S:
                return None, False
            self._started_s = None
        if word & HOMING_ERROR:
            raise DriveError(
                f"{self.what}: homing failed; check the home switch and drives.homing_method"
            )
        attained = bool(word & HOMING_ATTAINED)
        return attained, attained and bool(word & TARGET_REACHED)

    def follow(self) -> None:
        """Change to cyclic synchronous position mode, at rest, and start to exchange PDOs."""
        # The actual position is the first target: nothing moves when the mode changes.
        self._write(Object.TARGET_POSITION, self._read(Object.ACTUAL_POSITION))
        self._mode(Mode.CYCLIC_SYNCHRONOUS_POSITION)
        self._nmt(_OPERATIONAL)

    def stop(self) -> None:
        """Brake the drive and switch it off, without waiting for an answer.

        By SDO, because only operational nodes accept PDOs: during homing and start-up it is not.
        """
        self.link.send(SDO_REQUEST_ID + self.node_id, write_controlword(QUICK_STOP))

    def position(self) -> int:
        """Return the actual position in counts."""
        return self._read(Object.ACTUAL_POSITION)

    def listen(self, waits: bool) -> None:
        """Pass answers to canopen only while a request `waits`, else its queue would grow."""
        self._network.waits = waits

    def _syncs_are_counted(self) -> bool:
        """Return whether SYNC is counted, by object 0x1019; drives read it at start-up only."""
        overflow = self._read(Object.SYNC_OVERFLOW) if self._has(Object.SYNC_OVERFLOW) else 0
        if overflow not in (0, SYNC_COUNTER):
            raise DriverError(
                f"{self.what}: SYNC_OVERFLOW (0x1019): expected {SYNC_COUNTER}, or 0 for a SYNC "
                f"without counter, found {overflow}"
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
                self._write(Object.CONTROLWORD, 0)  # the fault reset needs a rising edge
            if state in TOWARDS_OPERATION:
                self._write(Object.CONTROLWORD, TOWARDS_OPERATION[state])
            sleep(_POLL_S)

    def _require_operation(self, word: int) -> None:
        """Raise DriveError, with the drive's error code, if operation is not enabled."""
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
        """Disable all PDOs that levid does not use: many drives have some enabled by default.

        They would load the bus beyond its budget, or move the drive.
        """
        for index in self._node.object_dictionary:
            if index in _OTHER_PDOS and self._has(index, 1):
                cob_id = self._read(index, 1)
                if not cob_id & _NOT_VALID:
                    self._write(index, cob_id | _NOT_VALID, 1)

    def _map(
        self, record: Object, mapping: Object, cob_id: int, objects: tuple[tuple[Object, int], ...]
    ) -> None:
        """Map a PDO by the procedure of CiA 301: disable, clear, fill, enable."""
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
            raise LinkError(f"{self.what}: {_name(index)}: {error}: {self.link.remedy}") from None
        except Exception as error:  # noqa: BLE001 - the EDS or the drive lacks the object
            raise DriverError(f"{self.what}: {_name(index)}: {error}") from None

    def _nmt(self, command: int) -> None:
        self.link.send(NMT_ID, bytes((command, self.node_id)))


def _name(index: int) -> str:
    return Object(index).name if index in _OBJECTS else f"0x{index:04X}"


class _LinkNetwork(canopen.Network):
    """Network of canopen on a CanLink."""

    def __init__(self, link: CanLink) -> None:
        super().__init__()
        self._link, self.waits = link, False
        self.answers = 0
        """Number of answers since the last request."""

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:  # noqa: ARG002
        self._link.send(can_id, bytes(data))

    def notify_now(self, can_id: int, data: bytes) -> None:
        """Pass an answer to canopen if a request waits for it.

        Length and number are checked here: canopen checks neither.
        """
        if self.waits and len(data) == _SDO_BYTES and self.answers < _MOST_ANSWERS:
            self.answers += 1
            self.notify(can_id, bytearray(data), 0.0)


class Answers:
    """Receives frames in a thread while canopen waits for SDO answers; between cycles only."""

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
            except DriverError:  # the waiting request times out
                return


def interpolation(sync_s: float) -> tuple[int, int]:
    """Return the nearest interpolation period (object 0x60C2): value and power of ten."""
    each = [(min(max(round(sync_s / 10.0**p), 1), 255), p) for p in (-3, -4, -5, -6)]
    # Of equally near ones the first: rounding errors of the conversion are ignored.
    return min(each, key=lambda it: round(abs(it[0] * 10.0 ** it[1] - sync_s), 12))
