"""Test the page and the command that compare two results."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.identification.greybox.identify_greybox import to_yaml


@pytest.fixture
def models(tmp_path: Path) -> list[Path]:
    """Two fits of the rig that differ in k_z, by nine standard errors, and a little elsewhere."""
    declared, rng, paths = load_model(shipped("models/rig.yaml")), np.random.default_rng(1), []
    for name in ("a", "b"):
        parameters = {}
        for n, p in declared.parameters.items():
            se = 1e-3 * abs(p.value)
            value = p.value + 0.3 * se * rng.standard_normal()
            value += 9 * np.sqrt(2) * se * (n == "k_z" and name == "b")
            parameters[n] = p.model_copy(update={"value": float(value), "se": se})
        paths.append(tmp_path / f"{name}.yaml")
        paths[-1].write_text(to_yaml(declared.model_copy(update={"parameters": parameters})))
    return paths


@pytest.mark.usefixtures("no_warnings")
def test_words_page_and_json(models: list[Path], tmp_path: Path, levid: Callable[..., Any]) -> None:
    out = tmp_path / "page"
    code, text, err = levid("compare", *models, "--at", "x_b=0.05", "--out", out)
    assert code == 0, err
    assert text.splitlines()[0].startswith("1 of ")
    assert "differ by more than chance: k_z" in text
    assert "x_b = 0.05" in text
    page = (out / "index.html").read_text()
    assert "differ by more than chance: k_z" in page
    assert {p.name for p in (out / "figures").iterdir()} == {
        "deviation.svg", "magnitude.svg", "phase.svg",
    }  # fmt: skip
    found = json.loads(levid("compare", *models, "--json").out)
    (k_z,) = (p for p in found["parameters"] if p["significant"])
    assert k_z["name"] == "k_z"
    assert k_z["in_errors"] == pytest.approx(9, abs=1)
    paths = {(p["input"], p["output"]): p for p in found["response"]["paths"]}
    # 1.3 % of stiffness are 0.11 dB below the resonance.
    assert abs(paths["tau_z", "z"]["decibel"]) > 0.1
    assert paths["tau_z", "z"]["p_value"] < 1e-3
    assert paths["tau_psi", "psi"]["p_value"] > 0.05


def test_wrong_arguments_say_what_there_is(
    models: list[Path], tmp_path: Path, levid: Callable[..., Any]
) -> None:
    for at, text in (("beam=1", "x_b"), ("x_b=far", "x_b=NUMBER")):
        code, _, err = levid("compare", *models, "--at", at)
        assert code == 2
        assert text in err
    code, _, err = levid("compare", models[0], tmp_path / "none")
    assert code == 1
    assert "none" in err
