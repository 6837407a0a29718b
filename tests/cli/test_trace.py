"""Test `levid trace` on a flight of a plant with one undeclared effect."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from short_trace_session import SESSION

from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.identification.comparison.saved_result import load_result
from levid.identification.greybox.identify_greybox import identify_grey_box
from levid.identification.records.record import IdentificationError
from levid.identification.trace.subtract_declared_effects import experiment_of
from levid.log.reader import read_log

Command = Callable[..., tuple[int, str, str]]
K3_N_M3 = 6e8


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory, run_levid: Callable[..., int]) -> Path:
    """Return logs of a plant with cubic rods; trace/ contains the results of `then: [trace]`."""
    folder = tmp_path_factory.mktemp("trace")
    (folder / "session.yaml").write_text(f"{SESSION}then: [trace]\n")
    sim = yaml.safe_load(shipped("sims/nominal.yaml").read_text())
    sim["effects"] = [
        {"use": "levid.sim.effects.stiffness:CubicRods", "dof": "z", "k3_n_m3": K3_N_M3}
    ]
    (folder / "sim.yaml").write_text(yaml.safe_dump(sim))
    session, plant, out = (folder / name for name in ("session.yaml", "sim.yaml", "logs"))
    assert run_levid("excite", session, "--sim", plant, "--virtual", "--out", out) == 0
    return folder / "logs"


def logs(flown: Path) -> list[Path]:
    return sorted(flown.glob("*.mcap"))


def test_trace_at_the_end_of_a_session_finds_the_effect(flown: Path) -> None:
    model = load_model(flown / "trace" / "model.yaml")
    (effect,) = model.effects
    assert (effect.effect, effect.where) == ("rod_stiffness.cubic", ("z",))
    k3 = effect.parameters["k3"]
    assert k3.unit == "N/m^3"
    assert k3.se is not None
    # Four standard errors: a correct fit exceeds them once in 16 000.
    assert abs(k3.value - K3_N_M3) < 4 * k3.se
    covariance = json.loads((flown / "trace" / "result.json").read_text())["covariance"]
    errors = [model.parameters[name].se for name in covariance["parameters"]]
    assert len(errors) == sum(p.se is not None for p in model.parameters.values())
    np.testing.assert_allclose(np.sqrt(np.diag(covariance["matrix"])), errors)
    assert load_result(flown / "trace").correlated

    page = (flown / "trace" / "index.html").read_text()
    assert page.lower().startswith("<!doctype html>")
    assert "Cubic stiffness at z" in page
    assert page.count("<figure") >= 7  # records, spectrum, effect, at least one round, residual
    assert not any(ord(c) < 32 and c not in "\n\t" for c in page)


def test_json_has_the_documented_keys(flown: Path, tmp_path: Path, levid: Command) -> None:
    code, out, _ = levid("trace", *logs(flown), "--out", tmp_path / "out", "--json", "--workers", 1)
    assert code == 0
    # Missing numbers are null: NaN is not JSON.
    result = json.loads(out, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))

    (effect,) = result["effects"]
    assert effect["class"] == "rod_stiffness"
    assert effect["where"] == ["z"]
    assert set(effect["parameters"]["k3"]) == {"value", "se", "unit"}
    evidence = effect["evidence"]
    assert evidence["equation"] == "force = -k3 q^3"
    assert evidence["statistic_sd"] > 6  # the threshold of the search
    assert {"alternatives", "absorbed_by", "told_apart_by"} <= set(evidence)

    validation = result["validation"]
    assert set(validation) == {
        *("metric", "about", "percent", "before", "after", "noise_floor", "noise_measured"),
        *("per_dof", "per_record"),
    }
    assert validation["metric"] == "free_run"
    # The excitation moves z far above the noise.
    assert validation["percent"]["after"]["z"] < 0.5 * validation["percent"]["before"]["z"] < 50
    assert set(validation["per_dof"]) == {"psi", "theta", "z"}
    assert validation["noise_measured"]
    second = next(r for r in validation["per_record"] if r["record"] == "second")
    assert set(second["per_dof"]) == {"psi", "theta", "z"}
    assert second["per_dof"]["z"]["before"] > 2 * second["per_dof"]["z"]["after"]
    # Apart from the effect the plant equals the declared model, so the residual is noise. Its RMS
    # over 10 s, with a slowest mode that decays in 0.7 s, scatters by about 5 %.
    assert validation["after"] < 1.2 * validation["noise_floor"]
    assert validation["before"] > 2 * validation["after"]
    assert not result["unexplained"]["significant"]

    # The result does not depend on the number of workers.
    (found,) = load_model(flown / "trace" / "model.yaml").effects
    assert effect["parameters"]["k3"]["value"] == found.parameters["k3"].value
    assert effect["parameters"]["k3"]["se"] == found.parameters["k3"].se


def test_results_are_printed_if_the_report_fails(
    flown: Path, tmp_path: Path, levid: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> Path:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("levid.report.trace.trace_page.trace_report", full)
    code, out, err = levid("trace", *logs(flown), "--out", tmp_path, "--workers", 1)
    assert code == 1
    assert "found: Cubic stiffness at z" in out
    assert f"model: {tmp_path / 'model.yaml'}" in out
    assert "report:" not in out
    assert "next:" not in out
    assert "the results are written, the report is not: " in err
    assert "No space left on device" in err
    assert load_model(tmp_path / "model.yaml").effects


def test_cluster_gives_the_same_result_to_the_last_digit(
    flown: Path, tmp_path: Path, levid: Command
) -> None:
    distributed = pytest.importorskip("distributed", reason="levid[cluster] is not installed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=2, host="127.0.0.1", dashboard_address=":0"
    ) as cluster:
        code, _, err = levid(
            "trace", *logs(flown), "--out", tmp_path, "--dask", cluster.scheduler_address
        )
    assert code == 0
    assert f"tracing on the cluster at {cluster.scheduler_address}" in err
    assert (tmp_path / "model.yaml").read_text() == (flown / "trace" / "model.yaml").read_text()


def test_trace_finds_no_effect_if_the_model_has_it(
    flown: Path, tmp_path: Path, levid: Command
) -> None:
    found = flown / "trace" / "model.yaml"
    code, out, _ = levid(
        "trace", *logs(flown), "--model", found, "--out", tmp_path / "again", "--workers", 1
    )
    assert code == 0
    assert "nothing found: the model explains the records down to the noise" in out
    assert "Cubic stiffness at z, declared: k3 = " in out
    before, after = (
        load_model(path / "model.yaml").effects[0].parameters["k3"]
        for path in (flown / "trace", tmp_path / "again")
    )
    # A new fit on the same records from its own result stays within the standard error.
    assert before.se is not None
    assert abs(after.value - before.value) < before.se
    page = (tmp_path / "again" / "index.html").read_text()
    assert "No undeclared effect was found" in page


def test_identify_includes_the_effects_of_the_model(flown: Path) -> None:
    model = load_model(flown / "trace" / "model.yaml")
    log = read_log(next(flown.glob("*-first.mcap")))
    over_floor = []
    for config in (model.model_copy(update={"effects": ()}), model):
        # z is excited in the last third of the record; the fit uses half of that.
        found = identify_grey_box(config, [experiment_of(log, config)], 1 / 6)
        (checked,) = found.validations
        over_floor.append(checked.error_rms[2] / checked.floor_rms[2])
    without, with_effects = over_floor
    # The RMS over 2.5 s of noise with a decay time of 0.7 s scatters by about a quarter.
    assert with_effects < 1.8
    assert without > 2 * with_effects


def test_nan_reading_in_a_log_is_reported_with_field_and_row(flown: Path) -> None:
    log, config = read_log(next(flown.glob("*-first.mcap"))), load_model(shipped("models/rig.yaml"))
    rows = log.rows.copy()
    rows["gap_m"][1200, 4] = np.nan
    with pytest.raises(
        IdentificationError,
        match=r"-first.mcap: gap_m\[4\]: .*row 1200",
    ):
        experiment_of(replace(log, rows=rows), config)


def test_errors_are_one_line(flown: Path, tmp_path: Path, levid: Command) -> None:
    some = logs(flown)
    file = tmp_path / "file"
    file.write_text("")
    for arguments, message in (
        ([*some, "--out", file], "expected a folder, found a file"),
        ([some[0], "--out", tmp_path / "o"], "expected records"),
        (
            [*some, "--out", tmp_path / "o", "--workers", 1, "--dask", "tcp://127.0.0.1:9"],
            "expected --workers or --dask, found both",
        ),
        ([tmp_path / "none.mcap", "--out", tmp_path / "o"], "none.mcap"),
    ):
        code, out, err = levid("trace", *arguments)
        assert code != 0
        assert out == ""
        assert message in err


def test_imported_logs_need_a_model(tmp_path: Path, levid: Command) -> None:
    t = np.arange(600) / 100
    np.savetxt(tmp_path / "data.csv", np.stack([np.sin(t), np.cos(t)], axis=1), delimiter=",")
    (tmp_path / "signals.yaml").write_text(
        "levid: signals\nname: made\nrate_hz: 100\ncolumns:\n"
        "  - {column: 0, name: u, unit: V, role: input}\n"
        "  - {column: 1, name: y, unit: V, role: output}\n"
    )
    log = tmp_path / "log.mcap"
    levid("import", tmp_path / "data.csv", "--signals", tmp_path / "signals.yaml", "-o", log)
    code, _, err = levid("trace", log, "--out", tmp_path / "out")
    assert code == 1
    assert "expected --model MODEL.yaml" in err


def test_unknown_effect_is_reported_with_its_file_and_key(
    flown: Path, tmp_path: Path, levid: Command
) -> None:
    text = (flown / "trace" / "model.yaml").read_text()
    wrong = tmp_path / "model.yaml"
    wrong.write_text(text.replace("rod_stiffness.cubic", "rod_stiffness.kubic"))
    for command in (("trace", "--workers", 1), ("identify",)):
        code, _, err = levid(*command, *logs(flown), "--model", wrong, "--out", tmp_path / "o")
        assert code == 1
        assert f"{wrong}: effects[0]: effect: expected" in err
        assert "rod_stiffness.cubic" in err
