"""Test studies of several logs: each log is used once, and one failing method does not end it."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from in_memory_log import without

from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.identification import run_identification as studies
from levid.identification.options import Options
from levid.identification.records.record import IdentificationError
from levid.log.reader import read_log
from levid.log.signals import cycle_dtype
from levid.log.writer import LogWriter

RIG = Path(shipped("rigs/loopback.yaml")).read_bytes()


@pytest.fixture
def logs(tmp_path: Path) -> list[Path]:
    """Return three logs of 4 s, one per input, with a sine: too poor for Markov parameters."""
    paths = []
    dtype = cycle_dtype(9, 9)
    for axis, field in enumerate(("psi_n_m", "theta_n_m", "z_n")):
        rows = np.zeros(4000, dtype)
        rows["cycle"] = 5000 * axis + np.arange(4000)
        rows[f"v_{field}"] = np.sin(2 * np.pi * 1.7 * 1e-3 * np.arange(4000))
        rng = np.random.default_rng(axis)
        for height in ("z_m", "psi_rad", "theta_rad"):
            rows[height] = 1e-7 * rng.normal(size=4000)
        paths.append(tmp_path / f"{axis}.mcap")
        metadata = {"kind": "record", "name": field, "session": "slow", "rate_hz": "1000"}
        with LogWriter(
            paths[-1], dtype, rate_hz=1000.0, metadata=metadata, attachments={"rig.yaml": RIG}
        ) as writer:
            writer.write(rows, (10**6 * rows["cycle"]).astype(np.uint64))
    return paths


def test_poor_excitation_skips_markov_parameters_and_fits_the_grey_box(logs, monkeypatch):
    def fitted(_model, experiments, *_rest):
        return SimpleNamespace(records=[e.name for e in experiments])

    monkeypatch.setattr(studies, "identify_grey_box", fitted)
    model = load_model(shipped("models/rig.yaml"))
    found = studies.study(logs, lambda _log: model, Options())
    assert found.points is None
    assert found.grey.records == ["psi_n_m", "theta_n_m", "z_n"]
    (note,) = found.notes
    assert note.startswith("no Markov parameters: beam at +0.0 mm: expected excitation")
    assert "fly white noise" in note


def test_poor_excitation_without_a_model_is_an_error(logs):
    with pytest.raises(IdentificationError, match="fly white noise"):
        studies.study(logs, lambda _log: None, Options())


def test_log_given_twice_is_used_once(logs, monkeypatch, tmp_path):
    counted = []

    def fitted(_model, experiments, *_rest):
        counted.append(len(experiments))
        return SimpleNamespace()

    monkeypatch.setattr(studies, "identify_grey_box", fitted)
    model = load_model(shipped("models/rig.yaml"))
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    copy = Path(shutil.copy(logs[1], folder))
    again = logs[0].parent / "elsewhere" / ".." / logs[0].name
    found = studies.study([*logs, again, copy], lambda _log: model, Options())
    assert counted == [3]
    assert any("0.mcap: given twice, used once" in note for note in found.notes)
    assert any(f"{copy}: the same record as {logs[1]}, used once" in n for n in found.notes)


def altered(log: Path, begin: int = 100, **columns: float) -> Path:
    """Return a copy of a log in which rows `begin` and on of these columns have one value."""
    was = read_log(log)
    rows, path = was.rows.copy(), log.with_name(f"altered-{log.name}")
    for name, value in columns.items():
        rows[name][begin:] = value
    metadata = {"kind": "record", "name": "altered", "session": "slow", "rate_hz": "1000"}
    with LogWriter(
        path, rows.dtype, rate_hz=1000.0, metadata=metadata, attachments={"rig.yaml": RIG}
    ) as writer:
        writer.write(rows, was.log_time_ns)
    return path


def test_invalid_log_does_not_end_the_study_of_others(logs, monkeypatch):
    monkeypatch.setattr(
        studies, "identify_grey_box", lambda _model, experiments, *_: SimpleNamespace(n=experiments)
    )
    model = load_model(shipped("models/rig.yaml"))
    broken, stuck = altered(logs[0], z_m=np.nan), altered(logs[1], stale=1)
    found = studies.study([broken, *logs, stuck], lambda _log: model, Options())
    assert len(found.grey.n) == 3
    notes = [note for note in found.notes if "altered-" in note]
    assert [note.partition(": expected")[0] for note in notes] == [
        f"{broken}: z_m",
        f"{stuck}: too many missing samples",
    ]
    with pytest.raises(IdentificationError, match="z_m: expected finite values"):
        studies.study([broken], lambda _log: model, Options())


def test_constant_output_is_noted(logs, monkeypatch):
    monkeypatch.setattr(studies, "identify_grey_box", lambda *_: SimpleNamespace())
    model = load_model(shipped("models/rig.yaml"))
    dead = altered(logs[0], begin=0, psi_rad=0.0)
    found = studies.study([dead, logs[1]], lambda _log: model, Options())
    notes = [note for note in found.notes if "is constant" in note]
    assert len(notes) == 1
    assert notes[0].startswith("altered-0.mcap: psi is constant")


def test_error_of_poor_excitation_states_why_the_model_was_not_fitted(logs):
    model = load_model(shipped("models/rig.yaml"))
    for path in logs:
        rewrite_without("beam_m_s", path)
    expected = "fly white noise.*; not used for the declared model: .* found no beam_m_s"
    with pytest.raises(IdentificationError, match=expected):
        studies.study(logs, lambda _log: model, Options())


def test_still_log_without_coil_forces_does_not_end_the_study(logs, monkeypatch):
    monkeypatch.setattr(
        studies, "identify", lambda records, *_rest: SimpleNamespace(points=records, skipped=())
    )
    monkeypatch.setattr(studies, "_doubt_notes", lambda _points: [])
    model = load_model(shipped("models/rig.yaml"))
    for path in logs:
        rewrite_without("coil_n", path, still=path == logs[0])
    found = studies.study(logs, lambda _log: model, Options())
    assert [record.name for record in found.points.points] == ["theta_n_m", "z_n"]


def rewrite_without(name, path, *, still=False):
    """Write the log again without a field; `still`: also without excitation."""
    log = without(read_log(path), name)
    rows = log.rows.copy()
    if still:
        for axis in ("v_psi_n_m", "v_theta_n_m", "v_z_n"):
            rows[axis] = 0.0
    path.unlink()
    with LogWriter(
        path, rows.dtype, rate_hz=1000.0, metadata=log.metadata, attachments=log.attachments
    ) as writer:
        writer.write(rows, log.log_time_ns)
