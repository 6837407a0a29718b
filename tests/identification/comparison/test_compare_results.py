"""Test comparisons: significance of known differences, responses, effects, saved results."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.stats import norm

from levid.config.base import ConfigError, parse_text
from levid.config.model import ModelConfig
from levid.config.shipped import shipped
from levid.identification.comparison.compare_results import compare, comparison_summary
from levid.identification.comparison.holm_correction import holm
from levid.identification.comparison.parameter_differences import (
    parameter_differences,
    whole_model_test,
)
from levid.identification.comparison.response_differences import compare_responses
from levid.identification.comparison.saved_result import SavedResult, load_result
from levid.identification.greybox.identify_greybox import to_yaml

MASS = parse_text(
    """
levid: model
name: mass
dof: [{name: x, unit: m}]
inputs: [{name: f, unit: N}]
parameters:
  m: {value: 2.0, unit: kg}
  d: {value: 6.0, unit: N s/m}
  k: {value: 800.0, unit: N/m}
M: [[m]]
D: [[d]]
K: [[k]]
""",
    ModelConfig,
    "mass",
)
FREE = ("m", "d", "k")
# Mass and stiffness are known together better than alone.
SD = np.array([0.004, 0.05, 1.5])
CORRELATION = np.array([[1.0, 0.1, 0.9], [0.1, 1.0, 0.2], [0.9, 0.2, 1.0]])
COVARIANCE = SD[:, None] * CORRELATION * SD


def result(offset: np.ndarray, name: str = "r", config: ModelConfig = MASS) -> SavedResult:
    """Return a result whose parameters are off by `offset` (3,)."""
    parameters = {
        n: p.model_copy(update={"value": p.value + x, "se": s})
        for (n, p), x, s in zip(
            config.parameters.items(), offset.tolist(), SD.tolist(), strict=True
        )
    }
    model = config.model_copy(update={"parameters": parameters})
    return SavedResult(Path(name), model, FREE, COVARIANCE, correlated=True)


def draws(seed: int, count: int) -> np.ndarray:
    return np.random.default_rng(seed).multivariate_normal(np.zeros(3), COVARIANCE, count)


def test_holm_of_a_published_example() -> None:
    # Holm's step-down by hand: 4 * 0.005, 3 * 0.01, then 2 * 0.03 which holds for the last too.
    np.testing.assert_allclose(holm([0.01, 0.04, 0.03, 0.005]), [0.03, 0.06, 0.06, 0.02])
    assert holm([]).size == 0


def test_chance_alone_is_called_different_as_often_as_stated() -> None:
    one, other = ([result(x) for x in draws(seed, 1000)] for seed in (1, 2))
    found = [parameter_differences(a, b) for a, b in zip(one, other, strict=True)]
    # Three standard errors of a share of 5 % in 1000 pairs are 2 %.
    assert np.mean([any(d.significant for d in pair) for pair in found]) < 0.07
    whole = [whole_model_test(a, b)[2] for a, b in zip(one, other, strict=True)]
    assert 0.03 < np.mean(np.array(whole) < 0.05) < 0.07
    covered = [d.interval[0] <= 0.0 <= d.interval[1] for pair in found for d in pair]
    assert 0.93 < np.mean(covered) < 0.97
    # The largest of all frequencies is compared with a bound that holds for all of them.
    responses = [compare_responses(a, b, {}) for a, b in zip(one[:60], other[:60], strict=True)]
    assert sum(any(p.p_value < 0.05 for p in r.paths) for r in responses) <= 6


def test_a_difference_of_six_standard_errors_is_found_alone() -> None:
    moved = np.array([0.0, 6.0 * np.sqrt(2.0) * SD[1], 0.0])
    found = compare(result(np.zeros(3)), result(moved))
    assert [d.name for d in found.significant] == ["d"]
    (d,) = found.significant
    assert d.in_errors == pytest.approx(6.0)
    assert d.p_value == pytest.approx(3 * 2 * norm.sf(6.0))
    assert found.verdict == "1 of 3 parameters differ by more than chance: d"
    # At the resonance the magnitude is that of the damping.
    (path,) = found.response.paths
    assert path.decibel_at_hz == pytest.approx(20.0 / (2 * np.pi), rel=0.01)
    ratio = 6.0 / (6.0 + moved[1])
    assert path.decibel == pytest.approx(20 * np.log10(ratio), rel=0.01)
    assert path.p_value < 1e-4


def test_the_band_of_a_response_is_the_scatter_of_drawn_parameters() -> None:
    response = compare(result(np.zeros(3)), result(np.zeros(3))).response
    s = 2j * np.pi * response.freq_hz
    m, d, k = (np.array([2.0, 6.0, 800.0]) + draws(3, 4000)).T[:, :, None]
    drawn = np.log(1.0 / (m * s**2 + d * s + k))
    np.testing.assert_allclose(response.a.error_re[:, 0, 0], drawn.real.std(axis=0), rtol=0.05)
    unwrapped = np.unwrap(drawn.imag, axis=1)
    np.testing.assert_allclose(response.a.error_im[:, 0, 0], unwrapped.std(axis=0), rtol=0.05)


def test_correlations_make_a_difference_visible() -> None:
    # Mass up and stiffness down by 1.5 errors each: against their correlation of 0.9.
    offset = np.array([1.5, 0.0, -1.5]) * SD * np.sqrt(2.0)
    found = compare(result(np.zeros(3)), result(offset))
    assert not found.significant
    assert found.whole[2] < 1e-4
    assert "differ as a whole" in found.verdict


def test_effects_of_one_result_alone_and_of_both(tmp_path: Path) -> None:
    text = shipped("models/rig.yaml").read_text()
    gain = """
  - effect: coil_gain
    where: ["coil:6"]
    parameters: {gain: {value: VALUE, unit: "1", se: 0.001}}"""
    (tmp_path / "a.yaml").write_text(f"{text}\neffects:{gain.replace('VALUE', '-0.02')}\n")
    other = """
  - effect: rod_stiffness.cubic
    where: ["z"]
    parameters: {k3: {value: 3.0e+8, unit: N/m^3, se: 1.0e+6}}"""
    (tmp_path / "b.yaml").write_text(f"{text}\neffects:{gain.replace('VALUE', '-0.05')}{other}\n")
    found = compare(load_result(tmp_path / "a.yaml"), load_result(tmp_path / "b.yaml"))
    (d,) = found.significant
    assert (d.effect, d.name) == ("coil_gain coil:6", "gain")
    assert [e.name for e in found.only_b] == ["rod_stiffness.cubic z"]
    assert found.only_a == ()
    assert "only B has: rod_stiffness.cubic z" in found.verdict
    json.dumps(comparison_summary(found), allow_nan=False)


def test_effects_have_the_names_that_trace_gave_them(tmp_path: Path) -> None:
    gain = {"value": -0.02, "se": 0.001, "unit": "1"}
    effect = {"effect": "coil_gain", "where": ["coil:6"], "parameters": {"gain": gain}}
    for side, effects in (("a", []), ("b", [effect])):
        folder = tmp_path / side
        folder.mkdir()
        model = yaml.safe_load(shipped("models/rig.yaml").read_text()) | {"effects": effects}
        (folder / "model.yaml").write_text(yaml.safe_dump(model))
        stated = [{**e, "name": "Gain of a coil at coil 6", "class": "coil"} for e in effects]
        result = {"command": "trace", "effects": stated}
        (folder / "result.json").write_text(json.dumps(result))
    found = compare(*(load_result(tmp_path / side) for side in ("a", "b")))
    assert [e.name for e in found.only_b] == ["Gain of a coil at coil 6"]


def saved(folder: Path, found: SavedResult, **more: object) -> Path:
    """Write the files of `levid identify`."""
    folder.mkdir()
    (folder / "model.yaml").write_text(to_yaml(found.model))
    grey = {
        "parameters": {n: {"value": p.value} for n, p in found.model.parameters.items()},
        "covariance": {"parameters": FREE, "matrix": COVARIANCE.tolist()},
    }
    plain = {"command": "identify", "grey_box": grey, "logs": [], **more}
    (folder / "result.json").write_text(json.dumps(plain))
    return folder


def test_saved_results_bring_their_covariance(tmp_path: Path) -> None:
    a = load_result(saved(tmp_path / "a", result(np.zeros(3))))
    np.testing.assert_allclose(a.covariance, COVARIANCE)
    assert a.correlated
    b = load_result(saved(tmp_path / "b", result(np.zeros(3)), logs=["/x/1.mcap"]))
    assert whole_model_test(a, b) == (0.0, 3, 1.0)
    # A result.json of another run than the model is not used.
    (tmp_path / "b" / "model.yaml").write_text(to_yaml(result(SD).model))
    stale = load_result(tmp_path / "b" / "model.yaml")
    assert not stale.correlated
    np.testing.assert_allclose(stale.covariance, np.diag(SD**2))
    assert any("no covariance" in note for note in compare(a, stale).notes)


def test_results_of_the_same_logs_are_not_independent(tmp_path: Path) -> None:
    logs = ["/x/1.mcap", "/x/2.mcap"]
    a, b = (
        load_result(saved(tmp_path / name, result(np.zeros(3)), logs=logs)) for name in ("a", "b")
    )
    assert any("2 logs in common" in note for note in compare(a, b).notes)


def test_models_of_other_plants_and_missing_models_say_so(tmp_path: Path) -> None:
    rig = load_result(shipped("models/rig.yaml"))
    found = compare(result(np.zeros(3)), rig)
    assert found.response is None
    assert any("different inputs or outputs" in note for note in found.notes)
    assert found.verdict.startswith("no parameter has a standard error in both")
    with pytest.raises(ConfigError, match=r"expected a result with model\.yaml"):
        load_result(tmp_path)
