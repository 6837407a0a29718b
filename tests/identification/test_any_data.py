"""Identify and trace absurd data: a result or a refusal with a remedy, never another error."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from mass_on_spring_logs import AT_50_HZ, imported

from levid.benchmarks.harness.loops_under_noise import Loop
from levid.config.base import ConfigError, parse_text
from levid.config.model import ModelConfig
from levid.identification.options import Options
from levid.identification.records.record import IdentificationError
from levid.identification.run_identification import study
from levid.identification.trace.force_trace.trace_imported import trace_imported
from levid.log.errors import LogError
from levid.model.effects import damping, stiffness
from levid.model.effects.base import Effect, Places
from levid.model.effects.operating_range import Extent

ROWS, TS = 240, 0.02
MODEL = """
levid: model
name: spring
dof: [{name: x_m, unit: m}]
inputs: [{name: f_n, unit: N}]
parameters:
  m: {value: 1.2, unit: kg, min: 0.1, max: 20}
  d: {value: 1.5, unit: N s/m, min: 0.01, max: 100}
  k: {value: 40, unit: N/m, min: 1, max: 1000}
M: [[m]]
D: [[d]]
K: [[k]]
"""
LOOP = "loop: {controller: unknown}\n"


def cases() -> dict[str, tuple[np.ndarray, np.ndarray, str]]:
    rng, k = np.random.default_rng(1), np.arange(ROWS)
    u = rng.normal(size=ROWS)
    loop = Loop(Ts_s=TS)
    y = Loop(Ts_s=TS, force=0.05).record(ROWS, 1, given=u).y[:, 0]
    step = (k > 40).astype(float)
    weak, none = (loop.record(ROWS, 2, excitation=e) for e in (0.01 * u, None))
    zero = np.zeros(ROWS)
    return {
        "constant": (zero + 1.0, zero + 2.0, ""),
        "silent": (zero, zero, ""),
        "dead output": (u, zero + 0.3, ""),
        "dead input": (zero, y, ""),
        "output that dies": (u, np.where(k < 20, y, 0.0), ""),
        "one row": (u[:1], y[:1], ""),
        "short": (u[:12], y[:12], ""),
        "just enough": (u[:50], y[:50], ""),
        "unstable": (u, np.exp(0.05 * k) * np.sin(k), ""),
        "unstable in a loop": (u, np.exp(0.05 * k) * np.sin(k), LOOP),
        "nan but two": (u, np.where(np.isin(k, (3, 77)), 1.0, np.nan), ""),
        "huge": (u, 1e30 * y, ""),
        "beyond numbers": (1e300 * u, 1e300 * y, ""),
        "tiny": (u, 1e-30 * y, ""),
        "nothing": (1e-300 * u, 1e-300 * y, ""),
        "equal": (u, u, ""),
        "step": (step, loop.record(ROWS, 3, given=step).y[:, 0], ""),
        "late step": ((k > 220).astype(float), zero + (k > 225), ""),
        "saturated": (np.clip(u, -0.2, 0.2), np.clip(y, -0.5 * y.std(), 0.5 * y.std()), ""),
        "one step of the reading": (np.round(u / 2.0), (k > 120).astype(float), ""),
        "large level": (u + 1e6, y + 1e6, ""),
        "weak loop": (weak.v[:, 0], weak.y[:, 0], LOOP),
        "loop without excitation": (none.v[:, 0], none.y[:, 0], ""),
        "not causal": (u, np.roll(u, -1), ""),
    }


CASES = cases()
QUICK = ("constant", "silent", "one row", "beyond numbers", "weak loop")
"""The cases that once ended in a traceback."""


@pytest.fixture
def log(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    u, y, loop = CASES[request.param]
    try:
        return imported(tmp_path, "a", np.column_stack([u, y]), AT_50_HZ + loop)
    except (ConfigError, LogError):
        pytest.skip("the import refuses it")


def few_effects(places: Places, covered: Extent) -> Sequence[Effect]:
    return [*stiffness.effects(places, covered), *damping.effects(places, covered)]


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize(
    "log",
    [n if n in QUICK else pytest.param(n, marks=pytest.mark.long) for n in CASES],
    indirect=True,
)
def test_any_data_give_a_model_or_a_refusal(log: Path) -> None:
    model = parse_text(MODEL, ModelConfig, "model")
    try:
        found = study([log], lambda _log: model, Options(order=2))
        assert found.points is not None or found.grey is not None
    except IdentificationError as refused:
        assert len(str(refused)) > 40  # noqa: PT017 - what was found, and what to do
    try:
        trace_imported([log], model, few_effects, lambda _what, _share: None)
    except IdentificationError as refused:
        assert len(str(refused)) > 40  # noqa: PT017
