"""Encode and decode the DBC's frames of a cycle, against cantools, which checks no checksum.

Before anything is timed, levid must accept every frame, and both must find the same bytes and the
same values.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cantools
import numpy as np

from levid.benchmarks.harness.benchmark_runner import Figure, Target, median_times
from levid.config.shipped import shipped
from levid.wire.can.can_frames import load_frames

CYCLE, COILS = 5, 9
BATCHES = 100
LEAST_TIMES = 5.0
Frame = tuple[int, bytes]


def codec_figures(n: int) -> list[Figure]:
    """Return the times of a cycle's frames; each contender has `n` calls."""
    figures: list[Figure] = []
    for fd, name, label in ((False, "can", "classic CAN"), (True, "canfd", "CAN FD")):
        us = median_us(contenders(fd), n)
        ours, theirs = us["encode"] + us["decode"], us["cantools_encode"] + us["cantools_decode"]
        figures += [
            Figure(f"{name}_encode_us", us["encode"], "us", f"{label}: encode a cycle"),
            Figure(f"{name}_decode_us", us["decode"], "us", f"{label}: decode and check a cycle"),
            Figure(f"{name}_cantools_us", theirs, "us", f"{label}: both, cantools, no checks"),
            Figure(
                f"{name}_codec_times", theirs / ours, "", f"{label}: cantools, times as long",
                target=Target(least=LEAST_TIMES),
            ),
        ]  # fmt: skip
    return figures


def median_us(contenders: dict[str, Callable[[], object]], n: int) -> dict[str, float]:
    """Return the time of a call in us: the median over BATCHES of the mean in each.

    The contenders take turns, batch by batch; each has `n` calls.
    """
    calls = max(n // BATCHES, 1)

    def batch(call: Callable[[], object]) -> Callable[[], None]:
        def run() -> None:
            for _ in range(calls):
                call()

        return run

    found = median_times({name: batch(call) for name, call in contenders.items()}, BATCHES)
    return {name: 1e6 * seconds / calls for name, seconds in found.items()}


def contenders(fd: bool) -> dict[str, Callable[[], object]]:
    """Return encoders and decoders; raises AssertionError if they disagree."""
    rng, frames = np.random.default_rng(1), load_frames(None, COILS, COILS, fd)
    forces_n, gaps_m = rng.uniform(-9, 9, COILS), rng.uniform(-9e-4, 9e-4, COILS)
    gap, force = np.zeros(COILS), np.zeros(COILS)
    readings = (
        (frames.gap, frames.gap.encode(gaps_m, CYCLE, 0), gap),
        (frames.force, frames.force.encode(forces_n, CYCLE, 0), force),
    )

    def encode() -> list[Frame]:
        return [frames.sync.encode(CYCLE), *frames.setpoint.encode(forces_n, CYCLE, 0)]

    def decode() -> bool:
        accepted = True
        for group, received, out in readings:
            group.begin()
            for can_id, data in received:
                accepted &= group.accept(can_id, data, CYCLE) is None
            accepted &= group.finish(out) is None
        return accepted

    database: Any = cantools.database.load_file(str(shipped("levid.dbc")))
    message_of = database.get_message_by_frame_id
    sent = [(message_of(can_id), data) for can_id, data in encode()]
    received = [(message_of(i), data) for _, batch, _ in readings for i, data in batch]
    numbers = [(message, message.decode(data, decode_choices=False)) for message, data in sent]

    def cantools_encode() -> list[bytes]:
        return [message.encode(values) for message, values in numbers]

    def cantools_decode() -> list[dict[str, Any]]:
        return [message.decode(data, decode_choices=False) for message, data in received]

    assert cantools_encode() == [data for _, data in encode()]
    assert decode()
    values = {k: v for signals in cantools_decode() for k, v in signals.items()}
    assert np.allclose(gap, [values[f"gap_{i}_m"] for i in range(COILS)], rtol=1e-12)
    assert np.allclose(force, [values[f"force_{i}_n"] for i in range(COILS)], rtol=1e-12)
    return {
        "encode": encode,
        "decode": decode,
        "cantools_encode": cantools_encode,
        "cantools_decode": cantools_decode,
    }
