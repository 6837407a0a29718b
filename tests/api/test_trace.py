"""Test `Session.trace` on imported data: effects, errors, plots, report, and the command's JSON."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from arrays_of_results import arrays_of

import levid
from levid.config.model import load_model

Command = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def traced(imported: levid.Session) -> levid.Trace:
    return imported.trace(warn=lambda _: None)


def test_effect_has_kind_place_parameters_and_support(traced: levid.Trace) -> None:
    effect = traced.effects[0]
    assert (effect.kind, effect.where) == ("stiffness", ("y",))
    (name, k3), *_ = effect.parameters.items()
    assert name == "k3"
    assert k3.unit == "N/m^3"
    assert k3.se is not None
    # Four standard errors: a correct fit exceeds them once in 16 000.
    assert abs(k3.value - 1e5) < 4 * k3.se
    assert effect.support is not None
    assert 0.0 < effect.support <= 1.0
    assert len(traced) == len(list(traced)) == len(traced.effects)
    assert "k3 = " in str(effect)


def test_errors_fall_and_are_explained(traced: levid.Trace) -> None:
    v = traced.validation
    assert v.before is not None
    assert v.after is not None
    assert v.after < v.before
    assert traced.explained is not None
    assert 0.9 < traced.explained <= 1.0
    assert traced.verdict.startswith("found: ")
    assert v.percent_after["y"] is not None


def test_arrays_of_the_results_are_read_only(traced: levid.Trace) -> None:
    arrays = dict(arrays_of(traced, "traced"))
    assert "traced.results.errors" in arrays
    assert [name for name, array in arrays.items() if array.flags.writeable] == []


def test_errors_that_are_not_numbers_are_shown_as_unknown(traced: levid.Trace) -> None:
    unknown = replace(traced.validation, before=None, after=None)
    assert "? % before, ? % after" in str(replace(unknown, metric="force"))
    assert "? before, ? after" in str(replace(unknown, metric="free_run"))


def test_model_with_the_effect_starts_another_identification(
    traced: levid.Trace, imported: levid.Session
) -> None:
    assert traced.model.effects == ("stiffness.cubic at y",)
    assert traced.parameters["m"].value == pytest.approx(2.0, rel=0.05)
    again = imported.identify(traced, warn=lambda _: None)
    assert again.model.effects == traced.model.effects


def test_plots_and_display(traced: levid.Trace, no_warnings: None) -> None:
    assert traced.plot()._repr_png_().startswith(b"\x89PNG")
    assert len(traced.plot(0).axes) >= 2
    assert "Trace of data" in repr(traced)
    assert "<table>" in traced._repr_html_()
    with pytest.raises(levid.IdentificationError, match="the trace has effects 0 to"):
        traced.plot(7)


def test_model_is_required_for_data_that_are_not_of_a_rig(measured: Path) -> None:
    without = levid.load(measured / "data.csv", signals=measured / "signals.yaml")
    with pytest.raises(levid.IdentificationError, match=r"expected model=MODEL\.yaml for"):
        without.trace()
    with pytest.raises(levid.IdentificationError, match=r"pass model='MODEL\.yaml'"):
        _ = without.identify(warn=lambda _: None).model


def test_json_equals_that_of_the_command(
    traced: levid.Trace, measured: Path, tmp_path: Path, levid: Command
) -> None:
    code, out, _ = levid(
        *("trace", traced.session.logs[0], "--model", measured / "model.yaml"),
        *("--out", tmp_path / "out", "--json"),
    )
    assert code == 0
    paths = {"model": None, "report": None}
    assert traced.to_json()["report"] is None
    page = traced.report(tmp_path / "own")
    own = json.loads(json.dumps(traced.to_json()))
    assert own["report"] == str(page)
    assert {**own, **paths} == {**json.loads(out), **paths}
    assert load_model(tmp_path / "own" / "model.yaml").effects
    traced.save(tmp_path / "saved")
    saved = json.loads((tmp_path / "saved" / "result.json").read_text())
    assert saved["effects"] == own["effects"]


def test_result_is_pickled(traced: levid.Trace) -> None:
    again = pickle.loads(pickle.dumps(traced))
    assert again.verdict == traced.verdict
    assert again.plot(0)._repr_png_().startswith(b"\x89PNG")
