"""Pass a plan from planner to supervisor in a memory file.

The file holds tables of fixed size and arrays: nothing has to be parsed. It is sealed before it is
read, and every offset is checked: the supervisor never reads beyond it, whatever the planner wrote.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import re
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ...config.session import MOST_STEPS
from ..control.coil_check import Pushes
from ..control.flight_segment import Segment
from ..control.preflight_findings import Check
from ..control.states import State
from .plan import MOST_CYCLES, MOST_NOTE, Plan, PlannedStep

_MAGIC = b"levidpl1"
_OPS = ("excite", "levitate", "move")
_KINDS = ("levitate", "move", "record", "land")
_CLIENT_GONE = ("", "go_on", "land")
_CHECKS = tuple(Check)
_PLACE: list[tuple[str, str]] = [("at", "<i8"), ("n", "<i8")]
_HEADER = np.dtype(
    [
        ("magic", "S8"),
        ("op", "<i8"),
        ("client_gone", "<i8"),
        ("override", "<i8"),
        ("rate_hz", "<f8"),
        ("coils", "<i8"),
        ("landing", "<i8", (2,)),
        ("name", "S128"),
        *((part, _PLACE) for part in ("out", "session", "note", "remark", "steps", "segments")),
    ]
)
_STEPS = np.dtype(
    [("index", "<i8"), ("kind", "<i8"), ("cycles", "<i8"), ("segments", "<i8"), ("name", "S128")]
)
_FLAGS = ("in_control", "airborne", "engages", "lands", "beam_feedforward")
_ARRAYS = ("v", "coil_excitation", "blend", "beam", "rotor")
_SEGMENTS = np.dtype(
    [
        ("state", "<i8"),
        ("cycles", "<i8"),
        *((flag, "<i8") for flag in _FLAGS),
        *((name, _PLACE) for name in _ARRAYS),
        ("push", "<i8"),
        ("pause", "<i8"),
        ("force_n", "<f8"),
    ]
)
_SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_WRITE
_ALIGNMENT = 8
_STATES = (State.IDLE, State.LEVITATING, State.EXCITING, State.MOVING, State.LANDING)
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_MOST_SEGMENTS, _MOST_SESSION = 8 * MOST_STEPS, 1 << 20
_MOST_NOTE_BYTES = 4 * MOST_NOTE
MOST_WORDS = 1 << 16
"""Longest refusal, path or note in bytes."""


class PlanFileError(Exception):
    """Report an invalid plan file."""


@dataclass(frozen=True)
class PlannedRequest:
    """Hold the plan of a request and all that the supervisor needs to fly it.

    op: `excite`, `levitate` or `move`. out: the log folder, empty for no log. landing: ramp and
    release cycles of an early landing; None keeps those of the flight. client_gone: `go_on`,
    `land`, or empty for the rig's setting. session: text of SESSION.yaml. note: journal line, empty
    for none. override: the preflight checks that the client takes upon itself.
    """

    op: str
    plan: Plan
    out: str = ""
    landing: tuple[int, int] | None = None
    client_gone: str = ""
    session: bytes = b""
    note: str = ""
    override: tuple[Check, ...] = ()


def memory_file(name: str, data: bytes = b"") -> int:
    """Create a memory file that can be sealed; return its descriptor. Raises OSError."""
    fd = os.memfd_create(name, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        _write(fd, memoryview(data))
    except BaseException:
        os.close(fd)
        raise
    return fd


def write_plan(fd: int, planned: PlannedRequest) -> None:
    """Write a planned request step by step, then seal the file; raises OSError."""
    plan = planned.plan
    header = np.zeros((), _HEADER)
    _write(fd, memoryview(header.tobytes()))
    steps, segments = np.zeros(len(plan.steps), _STEPS), []
    coils = 0
    for number, step in enumerate(plan.steps):
        found = step.segments()  # one step at a time: a record may take hundreds of MB
        for segment in found:
            coils = segment.coil_excitation.shape[1]
            segments.append(_write_segment(fd, segment))
        kind, name = _KINDS.index(step.kind), step.name.encode()
        steps[number] = (step.index, kind, step.cycles, len(found), name)
    header["magic"], header["op"] = _MAGIC, _OPS.index(planned.op)
    header["client_gone"] = _CLIENT_GONE.index(planned.client_gone)
    header["rate_hz"], header["coils"], header["name"] = plan.rate_hz, coils, plan.name.encode()
    header["override"] = sum(1 << _CHECKS.index(check) for check in set(planned.override))
    header["landing"] = (-1, -1) if planned.landing is None else planned.landing
    texts = planned.out.encode(), planned.session, planned.note.encode(), plan.note.encode()
    for part, text in zip(("out", "session", "note", "remark"), texts, strict=True):
        header[part] = _append(fd, memoryview(text)), len(text)
    table = np.array(segments, _SEGMENTS)
    header["steps"] = _append(fd, memoryview(steps.tobytes())), len(steps)
    header["segments"] = _append(fd, memoryview(table.tobytes())), len(table)
    os.pwrite(fd, header.tobytes(), 0)
    fcntl.fcntl(fd, fcntl.F_ADD_SEALS, _SEALS)


def write_refusal(fd: int, why: str) -> None:
    """Overwrite the file with the reason of a refusal, and seal it."""
    os.ftruncate(fd, 0)
    os.lseek(fd, 0, os.SEEK_SET)
    _write(fd, memoryview(why.encode(errors="replace")[:MOST_WORDS]))
    fcntl.fcntl(fd, fcntl.F_ADD_SEALS, _SEALS)


def read_refusal(fd: int) -> str:
    """Return the reason of a refusal."""
    return os.pread(fd, MOST_WORDS, 0).decode(errors="replace")


def read_plan(fd: int, coils: int) -> PlannedRequest:
    """Read and check a file of `write_plan`; its arrays stay in the file until they are used.

    Raises:
        PlanFileError: the file is not sealed, or a value in it is out of range.
    """
    if fcntl.fcntl(fd, fcntl.F_GET_SEALS) & _SEALS != _SEALS:
        raise PlanFileError("expected a sealed memory file, found one that can still change")
    size = os.fstat(fd).st_size
    if size < _HEADER.itemsize:
        raise PlanFileError(f"expected at least {_HEADER.itemsize} bytes, found {size}")
    memory = memoryview(mmap.mmap(fd, size, prot=mmap.PROT_READ))
    header = np.frombuffer(memory, _HEADER, 1)[0]
    if header["magic"] != _MAGIC:
        raise PlanFileError("expected a plan's format identifier at the start, found other data")
    _require(0 <= header["op"] < len(_OPS), "op")
    _require(0 <= header["client_gone"] < len(_CLIENT_GONE), "client_gone")
    _require(0 <= header["override"] < 1 << len(_CHECKS), "override")
    _require(bool(np.isfinite(header["rate_hz"])) and header["rate_hz"] > 0, "rate_hz")
    steps = _table(memory, header["steps"], _STEPS, "steps")
    segments = _table(memory, header["segments"], _SEGMENTS, "segments")
    _require(0 < len(steps) <= MOST_STEPS and len(segments) <= _MOST_SEGMENTS, "number of steps")
    _require(header["coils"] == coils, "coils")
    _require(bool((header["landing"] <= MOST_CYCLES).all()), "landing")
    _check_steps(steps, len(segments))
    _check_segments(segments, coils, size)
    firsts = np.concatenate([[0], np.cumsum(steps["segments"])]).tolist()
    plan = Plan(
        _text(header["name"]),
        float(header["rate_hz"]),
        tuple(
            PlannedStep(
                int(step["index"]),
                _KINDS[step["kind"]],  # type: ignore[arg-type]
                _text(step["name"]),
                int(step["cycles"]),
                partial(_read_segments, memory, segments[first:end], coils),
            )
            for step, first, end in zip(steps, firsts[:-1], firsts[1:], strict=True)
        ),
        _blob(memory, header["remark"], _MOST_NOTE_BYTES, "remark").decode(errors="replace"),
    )
    ramp, release = header["landing"].tolist()
    return PlannedRequest(
        _OPS[header["op"]],
        plan,
        _blob(memory, header["out"], MOST_WORDS, "out").decode(errors="replace"),
        (ramp, release) if ramp >= 0 and release >= 0 else None,
        _CLIENT_GONE[header["client_gone"]],
        _blob(memory, header["session"], _MOST_SESSION, "session"),
        _blob(memory, header["note"], MOST_WORDS, "note").decode(errors="replace"),
        tuple(check for i, check in enumerate(_CHECKS) if int(header["override"]) >> i & 1),
    )


def _write_segment(fd: int, segment: Segment) -> tuple[object, ...]:
    """Append the arrays of a segment; return its row of the segment table."""
    places = []
    for name in _ARRAYS:
        array = np.ascontiguousarray(getattr(segment, name), np.float64)
        places.append((_append(fd, array.data.cast("B")), len(array)))
    checks = segment.checks
    push = (checks.push, checks.pause, checks.force_n) if checks is not None else (0, 0, 0.0)
    flags = (int(getattr(segment, flag)) for flag in _FLAGS)
    return (int(segment.state), segment.cycles, *flags, *places, *push)


def _read_segments(memory: memoryview, table: NDArray[np.void], coils: int) -> list[Segment]:
    found = []
    for row in table:
        v, coil_excitation, blend, beam, rotor = (
            _read_array(memory, row[name], _columns(name, coils)) for name in _ARRAYS
        )
        flags = {flag: bool(row[flag]) for flag in _FLAGS}
        push, pause, force_n = int(row["push"]), int(row["pause"]), float(row["force_n"])
        checks = Pushes(push, pause, force_n, coils) if push else None
        state, cycles = State(int(row["state"])), int(row["cycles"])
        found.append(
            Segment(
                state, cycles, v, coil_excitation, blend, beam, rotor, **flags, checks=checks
            )
        )  # fmt: skip
    return found


def _read_array(memory: memoryview, place: np.void, columns: int) -> NDArray[np.float64]:
    at, n = place.tolist()
    return np.frombuffer(memory, np.float64, n * columns, at).reshape(n, columns)


def _check_steps(steps: NDArray[np.void], segments: int) -> None:
    _require(bool(((steps["kind"] >= 0) & (steps["kind"] < len(_KINDS))).all()), "kind")
    _require(bool((steps["index"] >= 0).all() and (steps["cycles"] >= 0).all()), "cycles")
    # Log files are named after steps.
    _require(all(_NAME.fullmatch(_text(name)) for name in steps["name"].tolist()), "name")
    counts = steps["segments"]
    _require(bool((counts >= 0).all() and (counts <= segments).all()), "segments")
    _require(int(counts.sum()) == segments, "segments")


def _check_segments(table: NDArray[np.void], coils: int, size: int) -> None:
    _require(bool(np.isin(table["state"], _STATES).all()), "state")
    cycles, push, pause = table["cycles"], table["push"], table["pause"]
    for counted in (cycles, push, pause):
        _require(bool(((counted >= 0) & (counted <= MOST_CYCLES)).all()), "cycles")
    _require(0 < int(cycles.sum()) <= MOST_CYCLES, "cycles")
    pushes = push > 0
    _require(bool((cycles == coils * (4 * push + pause))[pushes].all()), "push")
    for name in _ARRAYS:
        at, rows = table[name]["at"], table[name]["n"]
        row = 8 * _columns(name, coils)
        _require(bool((rows >= 1).all() and (rows <= size // row).all()), name)
        _require(bool((at >= 0).all() and (at <= size - rows * row).all()), name)
        _require(not (at % _ALIGNMENT).any(), name)


def _columns(name: str, coils: int) -> int:
    return coils if name == "coil_excitation" else 3


def _table(
    memory: memoryview, place: np.void, dtype: np.dtype[np.void], what: str
) -> NDArray[np.void]:
    at, n = place.tolist()
    _require(0 <= at <= len(memory) and 0 <= n <= (len(memory) - at) // dtype.itemsize, what)
    return np.frombuffer(memory, dtype, n, at)


def _blob(memory: memoryview, place: np.void, most: int, what: str) -> bytes:
    at, n = place.tolist()
    _require(0 <= at <= len(memory) and 0 <= n <= min(len(memory) - at, most), what)
    return bytes(memory[at : at + n])


def _require(good: bool, what: str) -> None:
    if not good:
        raise PlanFileError(f"{what}: the value is out of range")


def _text(field: bytes) -> str:
    return field.decode(errors="replace")


def _append(fd: int, data: memoryview) -> int:
    """Append data at the next aligned offset; return the offset."""
    at = os.lseek(fd, 0, os.SEEK_END)
    at = os.lseek(fd, -(-at // _ALIGNMENT) * _ALIGNMENT, os.SEEK_SET)
    _write(fd, data)
    return at


def _write(fd: int, data: memoryview) -> None:
    while len(data):
        data = data[os.write(fd, data) :]
