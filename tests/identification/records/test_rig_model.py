"""Test which model a rig's log starts from: that of the rig itself, and of no other one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from in_memory_log import cycle_log

from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.identification.records.rig_model import no_model, rig_model
from levid.log.signals import cycle_dtype

LOG = cycle_log("01-a.mcap", np.zeros(3, cycle_dtype(9, 9)))
RIG = LOG.attachments["rig.yaml"]
MODEL = b"model: ../models/rig.yaml"
EARLIER = b"feedforward: {mass_kg: 7.0, beam_mass_kg: 1.4, rods_n_m: 2600}"


def of(text: bytes):
    return replace(LOG, attachments={"rig.yaml": text})


def test_earlier_logs_of_the_shipped_rig_start_from_its_model() -> None:
    ours = load_model(shipped("models/rig.yaml"))
    for text in (RIG, RIG.replace(MODEL, EARLIER), RIG.replace(MODEL, b"model: rig")):
        assert rig_model(of(text)) == ours


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ((MODEL, EARLIER.replace(b"7.0", b"7.5")), "names no model"),
        ((MODEL, b"model: mine.yaml"), "names the model mine.yaml, which the log does not contain"),
        ((b"[0.12, 0.12, 0.12,", b"[0.11, 0.12, 0.12,"), "which the log does not contain"),
    ],
    ids=["masses", "own-model", "geometry"],
)
def test_another_rig_has_no_default_model(change: tuple[bytes, bytes], words: str) -> None:
    log = of(RIG.replace(*change))
    assert rig_model(log) is None
    why = no_model(log)
    assert words in why
    assert "the rig 'loopback'" in why
    assert "`levid new model rig -o MODEL.yaml`" in why
