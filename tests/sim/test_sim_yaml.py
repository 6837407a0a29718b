"""Test SIM.yaml: the shipped files, and errors that name file and key."""

from pathlib import Path

import pytest
from repository_folders import SIMS

from levid.config.base import ConfigError, load_yaml
from levid.config.sim import SimConfig


def test_shipped_files_have_equal_declared_parameters() -> None:
    """rig.yaml and nominal.yaml differ only in plant level and imperfections."""
    nominal, rig = (load_yaml(SIMS / f"{name}.yaml", SimConfig) for name in ("nominal", "rig"))
    same = {"plant", "nonlinear"}
    assert nominal.model_dump(exclude=same) == rig.model_dump(exclude=same)
    assert nominal.nonlinear is None


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("r_m: 0.12", "r_mm: 120", "geometry.r_mm: unknown key; expected 'r_m'"),
        (
            "m_p_kg: 5.6",
            "m_p_kg: -5.6",
            "platform.m_p_kg: expected a number greater than 0, found -5.6",
        ),
        ("step_s: 1e-4", "step_s: 1e-3", "step_s: expected a number of at most 0.0001"),
        ("step_s: 1e-4", "step_s: 1e-12", "step_s: expected a number of at least 1e-06"),
        ("lag_s: 3e-4", "lag_s: 1e9", "coils.lag_s: expected a number of at most 1, found"),
        ("noise_hold_s: 1e-4", "noise_hold_s: 1e-9", "coils.noise_hold_s: expected a number of at"),
        ("plant: declared", "plant: nonlinear", "nonlinear: required section is missing"),
        ("plant: declared", "plant: linear", "expected 'declared' or 'nonlinear', found 'linear'"),
        ("0, -0.12]\n\nplat", "0]\n\nplat", "expected as many coil_x_m as coil_y_m, found 9 and 8"),
        ("effects: []", "effects: [{use: spring}]", "expected 'path/to/file.py:ClassName'"),
        ("effects: []", "effects: [{k: 1}]", r"effects\[0\].use: required key is missing"),
        ("j_psitheta_kg_m2: 0.0015", "j_psitheta_kg_m2: 1", "expected its square below"),
        ("lag_s: 3e-4", "lag_s: .nan", "coils.lag_s"),
    ],
)
def test_mistake_names_file_and_key(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = (SIMS / "nominal.yaml").read_text()
    assert text.count(old) >= 1
    (tmp_path / "SIM.yaml").write_text(text.replace(old, new))
    with pytest.raises(ConfigError, match=rf"SIM\.yaml.*{message}"):
        load_yaml(tmp_path / "SIM.yaml", SimConfig)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("plant: nonlinear", "plant: declared", "expected no such section"),
        ("coil_gain: [1.002, ", "coil_gain: [", "nonlinear.coil_gain: expected 9 values"),
        ("j_z_kg_m2: 0.115", "j_z_kg_m2: 0.2", "nonlinear.j_z_kg_m2: expected less than"),
    ],
)
def test_mistake_in_the_imperfections(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = (SIMS / "rig.yaml").read_text()
    assert old in text
    (tmp_path / "SIM.yaml").write_text(text.replace(old, new))
    with pytest.raises(ConfigError, match=message):
        load_yaml(tmp_path / "SIM.yaml", SimConfig)


def test_three_coils_on_a_line_are_rejected(tmp_path: Path) -> None:
    text = (SIMS / "nominal.yaml").read_text()
    line = "[0.12, 0.12, 0.12, 0, 0, 0, -0.12, -0.12, -0.12]"
    text = text.replace(f"coil_y_m: {line}", "")
    start = text.index("  coil_x_m")
    end = text.index("\nplatform")
    (tmp_path / "SIM.yaml").write_text(
        text[:start] + "  coil_x_m: [0, 1, 2]\n  coil_y_m: [0, 1, 2]\n" + text[end:]
    )
    with pytest.raises(ConfigError, match="not on one line"):
        load_yaml(tmp_path / "SIM.yaml", SimConfig)
