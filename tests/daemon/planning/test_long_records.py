"""Test that records of hours are checked in little memory, and as they are flown."""

from __future__ import annotations

import time

import numpy as np
import pytest
from measured_command import levid

from levid.config.base import ConfigError, parse_text
from levid.config.rig import RigConfig, load_rig
from levid.config.session import SessionConfig
from levid.config.shipped import shipped
from levid.daemon.planning.plan import plan_session
from levid.model.geometry import decoupling_matrix, shape_matrix

LIMIT_BYTES = 300e6
LONGER_COSTS = 12.0
"""Processor time that the length of the records costs, over that of drawing a random number for
each axis in each of their cycles, in the same run: two for the peak, six for the motion. A loop
over cycles costs over 15 more."""
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


def test_check_takes_little_memory_and_time(tmp_path) -> None:
    """Seven records of 4000 s at 1 kHz would take 0.4 GB each as a whole."""
    cost_s = {}
    for length_s in (4.0, 4000.0):
        file = tmp_path / "s.yaml"
        text = session(length_s, *KINDS)
        file.write_text(text if length_s > 1000 else text.replace("period_s: 1000", "period_s: 4"))
        code, text, peak, cost_s[length_s] = levid("check", file)
        assert code == 0, text
        assert peak < LIMIT_BYTES
    assert cost_s[4000.0] - cost_s[4.0] < LONGER_COSTS * drawing_s(len(KINDS) * 4_000_000)


def drawing_s(cycles: int) -> float:
    """Return the processor time in s of drawing a normal number for every axis and cycle."""
    rng = np.random.default_rng(1)
    began_s = time.thread_time()
    for _ in range(cycles // 10_000):
        rng.standard_normal((10_000, 3))
    return time.thread_time() - began_s


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
