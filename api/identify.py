"""Identify the plant from the logs of a session."""

from __future__ import annotations

import warnings
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ..config.base import load_yaml
from ..config.shipped import find_file
from ..config.sim import SimConfig
from ..identification.records.rig_model import rig_model
from ..identification.run_identification import study
from .identification import Identification
from .model import ArgumentError, ModelSource, model_config
from .model_file_errors import naming_the_file

if TYPE_CHECKING:
    from ..config.model import ModelConfig
    from ..identification.options import Options
    from ..log.reader import Log
    from .session import Progress, Session, Warn


def identify(
    session: Session,
    model: ModelSource | None,
    options: Options,
    truth: str | Path | None = None,
    progress: Progress | None = None,
    warn: Warn | None = None,
) -> Identification:
    """Identify the plant from the session's logs by every method that the records allow.

    Raises:
        ConfigError: a model or simulator file is wrong.
        IdentificationError: the logs cannot be identified.
        LogError: a file is not a log, or the logs are of two rigs.
    """
    say = warn or partial(warnings.warn, stacklevel=4)
    # Check everything that needs no log before the long work.
    declared, file = model_config(session.model if model is None else model)
    session.require_one_plant()
    simulator = None if truth is None else load_yaml(find_file(truth, "sim"), SimConfig)
    flown = False

    def model_of(log: Log) -> ModelConfig | None:
        nonlocal flown
        flown = "rig.yaml" in log.attachments
        if truth is not None and not flown:
            raise ArgumentError(f"{{}}: expected logs of the rig, found {log.path}", "truth")
        return declared or rig_model(log)

    with naming_the_file(file):
        found = study(session.logs, model_of, options, progress, say)
    for remark in () if found.grey is None else found.grey.remarks:
        if remark not in found.before:
            say(remark)
    return Identification(session, found, simulator if flown else None, flown)
