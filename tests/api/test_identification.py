"""Test `Session.identify`: parameters, modes, plants, plots, report, and the command's JSON."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import levid
from levid.config.base import load_yaml
from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.config.sim import SimConfig
from levid.sim.true_response import frequency_response

Command = Callable[..., tuple[int, str, str]]


def test_parameters_have_value_error_unit_and_interval(found: levid.Identification) -> None:
    mass = found.parameters["m_p"]
    assert mass.unit == "kg"
    assert mass.declared == 5.6
    assert mass.se is not None
    assert mass.interval == pytest.approx(
        (mass.value - 1.96 * mass.se, mass.value + 1.96 * mass.se)
    )
    # The plant has the declared mass; five standard errors are exceeded once in two million.
    assert abs(float(mass) - 5.6) < 5 * mass.se
    fixed = found.parameters["g"]
    assert fixed.se is None
    assert fixed.interval is None
    with pytest.raises(KeyError, match="one of the parameters r, g, m_p"):
        found.parameters["m"]


def test_model_is_saved_and_read_again(
    found: levid.Identification, session: levid.Session, tmp_path: Path
) -> None:
    path = found.model.save(tmp_path / "new" / "model.yaml")
    assert load_model(path).parameters["m_p"].value == found.parameters["m_p"].value
    assert "m_p = 5.6" in repr(found.model)
    again = levid.load(session.logs, model=path)
    assert again.model == path


def test_modes_are_those_of_the_plant(found: levid.Identification) -> None:
    # sqrt(k / m) / 2 pi of z is 3.07 Hz with the beam's mass; those of the tilts are near 9 Hz.
    frequencies = [mode.frequency.value for mode in found.modes]
    assert frequencies == pytest.approx([3.07, 8.7, 8.9], rel=0.02)
    assert all(mode.frequency.se is not None for mode in found.modes)
    assert "Hz" in repr(found.modes)
    assert "<table>" in found.modes._repr_html_()


@pytest.mark.parametrize("method", ["recommended", "subspace", "ho_kalman", "fitted"])
def test_plants_have_the_true_response(found: levid.Identification, method: str) -> None:
    plant = found.plant(method)
    assert plant.Ts_s == 2e-3
    assert plant.outputs == ("psi", "theta", "z")
    assert plant.beam_m == pytest.approx(0.0, abs=1e-4)
    freq_hz = np.array([2.0, 6.0, 32.0])
    sim = load_yaml(shipped("sims/nominal.yaml"), SimConfig)
    true = frequency_response(sim, 0.0, freq_hz, 500.0)
    for i in range(3):
        # Records of 9 s determine it to about 10 %; a wrong delay or unit gives a larger error.
        np.testing.assert_allclose(plant.response(freq_hz)[:, i, i], true[:, i, i], rtol=0.3)
    assert plant.to_scipy().dt == 2e-3


def test_fitted_plant_follows_the_beam(found: levid.Identification) -> None:
    middle, right = found.plant("fitted"), found.plant("fitted", beam_m=0.08)
    assert right.beam_m == 0.08
    assert not np.allclose(middle.response([3.0]), right.response([3.0]))


def test_python_control_gets_names(found: levid.Identification) -> None:
    pytest.importorskip("control", reason="levid[control] is not installed")
    assert found.to_control().output_labels == ["psi", "theta", "z"]


def test_errors_list_what_there_is(found: levid.Identification, imported: levid.Session) -> None:
    with pytest.raises(levid.IdentificationError, match="subspace, ho_kalman, fitted; found 'arx'"):
        found.plant("arx")  # type: ignore[arg-type]
    with pytest.raises(levid.IdentificationError, match="bode, outputs; found 'nyquist'"):
        found.plot("nyquist")  # type: ignore[arg-type]
    with pytest.raises(levid.IdentificationError, match="truth: expected logs of the rig"):
        imported.identify(truth=shipped("sims/nominal.yaml"))


def test_plots_and_display(found: levid.Identification, no_warnings: None) -> None:
    assert len(found.plot("bode").axes) == 18  # magnitude and phase of nine paths
    assert len(found.plot("outputs").axes) == 3
    assert "m_p" in repr(found)
    page = found._repr_html_()
    assert page.count("<table>") == 2
    assert "Identification of short" in page


def test_report_and_results_are_written(found: levid.Identification, tmp_path: Path) -> None:
    assert found.to_json()["report"] is None
    page = found.report(tmp_path / "report")
    assert page.read_text().lower().startswith("<!doctype html>")
    assert (tmp_path / "report" / "model.yaml").exists()
    assert found.to_json()["report"] == str(page)
    found.save(tmp_path / "saved")
    assert {p.name for p in (tmp_path / "saved").iterdir()} == {
        *("model.yaml", "result.json", "identified.mat"),
    }
    saved = json.loads((tmp_path / "saved" / "result.json").read_text())
    assert saved == found.to_json()
    (tmp_path / "file").write_text("")
    with pytest.raises(levid.ConfigError, match="expected a folder, found a file"):
        found.report(tmp_path / "file")


def test_result_is_pickled(found: levid.Identification) -> None:
    again = pickle.loads(pickle.dumps(found))
    assert again.parameters["m_p"] == found.parameters["m_p"]
    assert again.session.names == ("psi", "theta", "z")


@pytest.mark.usefixtures("unwritten_figures")
def test_json_equals_that_of_the_command(
    imported: levid.Session, measured: Path, tmp_path: Path, levid: Command
) -> None:
    log, model = imported.logs[0], measured / "model.yaml"
    code, out, _ = levid("identify", log, "--model", model, "--out", tmp_path / "out", "--json")
    assert code == 0
    own = imported.identify(warn=lambda _: None)
    own.report(tmp_path / "own")
    result = {**json.loads(out), "report": None}
    assert {**json.loads(json.dumps(own.to_json())), "report": None} == result
    assert own.parameters["m"].unit == "kg"
    assert own.plant().method == "prediction_error"
    assert len(own.plot().axes) == 2
