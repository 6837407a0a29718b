"""Open-loop records simulated with the rig's declared model and known noise."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from effect_test_helpers import rig_places

from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.greybox.free_parameters import free_parameters
from levid.identification.greybox.prediction.discretisation import innovations, motion
from levid.identification.greybox.prediction.noise_model import Noise
from levid.identification.trace.linearised.linearisation_point import WorkingPoint
from levid.identification.trace.records.record_from_log import TraceRecord
from levid.identification.trace.records.sensor_and_amplifier_noise import Disturbance

TS = 1e-3
CONFIG = load_model(shipped("models/rig.yaml"))
PLACES = rig_places((0.0, 20.0))
SHAPE = PLACES.sensor_shape
SENSOR_SD = 1e-7
NOISE = Noise.independent(
    np.diag(SHAPE.T @ SHAPE) * 1e-10, np.diag(np.linalg.pinv(SHAPE.T @ SHAPE)) * 1e-14
)


def smooth(rng: np.random.Generator, rows: int, columns: int, highest_hz: float) -> np.ndarray:
    """Return sums of twelve sines, as smooth as the platform's motion."""
    t, freq_hz = np.arange(rows) * TS, rng.uniform(0.5, highest_hz, (12, columns))
    phase = rng.uniform(0, 2 * np.pi, freq_hz.shape)
    return np.sin(2 * np.pi * freq_hz * t[:, None, None] + phase).sum(axis=1) / np.sqrt(6)


@cache
def record(kind: str, rows: int = 3000) -> TraceRecord:
    """Return a record of the declared model without weight; the beam is "still" or "moving"."""
    rng = np.random.default_rng(len(kind))
    t = np.arange(rows) * TS
    beam = np.full((rows, 3), [0.05, 0.0, 0.0])
    if kind == "moving":
        w = 2 * np.pi * 0.4
        beam = 0.07 * np.stack([np.sin(w * t), w * np.cos(w * t), -w * w * np.sin(w * t)], axis=1)
    coil = smooth(rng, rows, 9, 40.0)
    derivative = np.append(np.diff(beam[:, 1]), 0.0) / TS
    schedule = {"x_b": beam[:, 0], "v_b": beam[:, 1], "a_b": derivative}
    e = Experiment(
        kind, TS, coil @ SHAPE, np.zeros((rows, 3)), schedule, frozenset({"a_b"}),
        kind == "moving", 1, hold="zoh",
    )  # fmt: skip
    at = motion(declared_model(CONFIG), e, "zoh")
    # A filter without gain simulates: with y = 0 its innovation is minus the pose.
    q = -innovations(at, np.zeros((len(at.K), 6, 3)), e.y, np.zeros(6))
    gap = q @ SHAPE.T + SENSOR_SD * rng.standard_normal((rows, 9))
    return TraceRecord(
        replace(e, y=gap @ PLACES.decoupling.T), PLACES, t, gap, coil, np.zeros_like(coil), beam,
        np.zeros((rows, 3)), None, "made",
    )  # fmt: skip


def point(**values: float) -> WorkingPoint:
    model = declared_model(CONFIG).with_values(values)
    known = Disturbance(NOISE, SENSOR_SD, measured=True)
    return WorkingPoint(model, free_parameters(CONFIG), (), known, "zoh")
