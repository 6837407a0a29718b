"""Test that records of hours are checked in little memory, and as they are flown."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from types import FrameType
from typing import Any

import numpy as np
import pytest
from measured_command import levid

from levid.config.base import ConfigError, parse_text
from levid.config.rig import RigConfig, load_rig
from levid.config.session import SessionConfig
from levid.config.shipped import shipped
from levid.daemon.planning.plan import plan_session
from levid.daemon.planning.session_plausibility import session_problems
from levid.model.geometry import decoupling_matrix, shape_matrix

LIMIT_BYTES = 300e6
LINES_PER_CYCLE = 0.1
"""Lines of Python that a cycle of a record may take: the motion takes two for 64 cycles. A loop
over cycles takes at least one for each."""
SINE = "signal: multisine, period_s: 8, band_hz: [1, 100]"
KINDS = {
    "white noise": ("", "psi, theta, z", "duration_s: {s}"),
    "noise in a band": ("band_hz: [1, 100]", "theta", "duration_s: {s}"),
    "multisines": (SINE, "psi, theta, z", "duration_s: {s}"),
    "long periods": (
        "signal: multisine, period_s: 1000, band_hz: [1, 100]",
        "psi, theta, z",
        "duration_s: {s}",
    ),
    "orthogonal": (SINE, "psi, theta, z", "orthogonal: {{realisations: {n}, periods: 8}}"),
    "coils in turn": ("", "c0, c1, c2, c3", "each_s: {each}"),
    "beam": ("", "z", "beam: [{{to_m: 0.05}}, {{to_m: 0, dwell_s: 1}}], duration_s: {s}"),
}


def session(length_s: float, *kinds: str) -> str:
    """Return a session with a record of each kind."""
    excitations, records = [], []
    for kind in kinds:
        form, played, length = KINDS[kind]
        names = [f"{kind.replace(' ', '-')}-{name}" for name in played.split(", ")]
        for name, excited in zip(names, played.split(", "), strict=True):
            level = "rms_n_m: 0.01" if excited in ("psi", "theta") else "rms_n: 0.02"
            keys = [f"input: '{excited.replace('c', 'coil:')}'", level, *filter(None, [form])]
            excitations.append(f"  {name}: {{{', '.join(keys)}}}\n")
        each, n = length_s / len(names), max(int(length_s / (8 * 8 * len(names))), 1)
        record = length.format(s=length_s, each=each, n=n)
        name = kind.replace(" ", "-")
        records.append(f"- record: {{name: {name}, excite: [{', '.join(names)}], {record}}}\n")
    return (
        f"levid: session\nname: long\nexcitations:\n{''.join(excitations)}"
        f"steps:\n- levitate: {{}}\n{''.join(records)}- land: {{}}\n"
    )


@pytest.fixture
def rig() -> RigConfig:
    return load_rig(shipped("rigs/loopback.yaml"))


def test_check_takes_little_memory(tmp_path) -> None:
    """Seven records of 4000 s at 1 kHz would take 0.4 GB each as a whole."""
    file = tmp_path / "s.yaml"
    file.write_text(session(4000.0, *KINDS))
    code, text, peak, _ = levid("check", file)
    assert code == 0, text
    assert peak < LIMIT_BYTES


@pytest.mark.parametrize("kind", KINDS)
def test_no_loop_runs_over_the_cycles_of_a_record(kind: str, rig: RigConfig) -> None:
    lines = {}
    for length_s in (100.0, 1000.0):
        text = session(length_s, kind).replace("period_s: 1000", "period_s: 90")
        config = parse_text(text, SessionConfig, "s")
        lines[length_s] = lines_run(partial(_check, config, rig))
    assert lines[1000.0] - lines[100.0] < LINES_PER_CYCLE * 900 * rig.rate_hz


def _check(session: SessionConfig, rig: RigConfig) -> None:
    session_problems(session, rig, plan_session(session, rig))


def lines_run(function: Callable[[], object]) -> int:
    """Return how many lines of Python a call executes: what it costs, without a clock."""
    lines = 0

    def count(_: FrameType, event: str, __: object) -> Any:
        nonlocal lines
        lines += event == "line"
        return count

    before = sys.gettrace()
    sys.settrace(count)
    try:
        function()
    finally:
        sys.settrace(before)
    return lines


@pytest.mark.parametrize("kind", KINDS)
def test_blocks_are_what_is_flown(kind: str, rig: RigConfig) -> None:
    text = session(64.0 if kind == "orthogonal" else 40.0, kind)
    if kind == "long periods":
        text = text.replace("period_s: 1000", "period_s: 39")
    plan = plan_session(parse_text(text, SessionConfig, "s"), rig)
    step = plan.steps[1]
    assert step.excitation is not None
    *_, flown = step.segments()
    coils = shape_matrix(rig.geometry.coil_x_m, rig.geometry.coil_y_m)
    wrench = np.concatenate([block.wrench(coils) for block in step.excitation.blocks()])
    np.testing.assert_allclose(
        wrench, np.broadcast_to(flown.v + flown.coil_excitation @ coils, wrench.shape), atol=1e-12
    )
    assert len(wrench) == flown.cycles
    T_coils = decoupling_matrix(rig.geometry.coil_x_m, rig.geometry.coil_y_m)
    forces = flown.v @ T_coils + flown.coil_excitation
    squares = sum(block.coil_squares(T_coils) for block in step.excitation.blocks())
    np.testing.assert_allclose(
        squares, np.square(forces).sum(axis=0) * (flown.cycles // len(forces))
    )
    peak_n = np.abs(flown.v @ T_coils).max() + np.abs(flown.coil_excitation).max()
    np.testing.assert_allclose(step.excitation.peak_n(T_coils), peak_n, rtol=1e-12)


def test_a_level_that_overflows_is_refused(rig: RigConfig) -> None:
    text = session(10.0, "white noise").replace("0.01", "1e308")
    text = text.replace("duration_s", "scale: 1e3, duration_s")
    with pytest.raises(ConfigError, match="saturate"):
        plan_session(parse_text(text, SessionConfig, "s"), rig)
