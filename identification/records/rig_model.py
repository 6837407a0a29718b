"""Find the declared model of the rig that flew a log, or say why there is none."""

from __future__ import annotations

from pathlib import PurePosixPath

from ...config.model import ModelConfig, load_model
from ...config.rig import FeedForward, RigConfig, load_rig
from ...config.shipped import shipped
from ...log.reader import Log
from .from_log import attached, rig_of

_SHIPPED_MODEL = "models/rig.yaml"
_FEED_FORWARD = FeedForward(mass_kg=7.0, beam_mass_kg=1.4, rods_n_m=2600.0)
"""Feed-forward of the shipped rigs before rigs named a model."""


def rig_model(log: Log) -> ModelConfig | None:
    """Return the declared model of the rig that flew the log; None for a log without one.

    It is the attachment model.yaml. A log of the shipped rig that an early version wrote has none:
    its model is the shipped models/rig.yaml. No other rig has a default model.

    Raises IdentificationError for an attachment that is not a model, or not a rig.
    """
    if "rig.yaml" not in log.attachments:
        return None
    if "model.yaml" in log.attachments:
        return attached(log, "model.yaml", ModelConfig)
    return load_model(shipped(_SHIPPED_MODEL)) if _is_shipped(rig_of(log)) else None


def no_model(log: Log) -> str:
    """Return why the log of a rig has no declared model, and how to declare one."""
    rig = rig_of(log)
    missing = "names no model"
    if rig.model is not None:
        missing = f"names the model {rig.model}, which the log does not contain"
    return (
        f"{log.path}: the rig '{rig.name}' {missing}, so no physical parameters can be fitted. "
        "`levid new model rig -o MODEL.yaml` writes a model to edit: enter the rig's masses, "
        "inertias and stiffnesses, and give it with --model MODEL.yaml, or name it in the rig's "
        "file (model: MODEL.yaml) for later flights"
    )


def _is_shipped(rig: RigConfig) -> bool:
    """Return whether a rig without an attached model is the shipped one."""
    ours = load_rig(shipped("rigs/loopback.yaml"))
    if rig.geometry != ours.geometry:
        return False
    if rig.model is None:
        return rig.feedforward == _FEED_FORWARD
    named = rig.model if isinstance(rig.model, str) else rig.model.name
    return PurePosixPath(named).stem == PurePosixPath(_SHIPPED_MODEL).stem
