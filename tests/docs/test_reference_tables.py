"""Test the tables of docs/ against the code, and the examples of docs/configuration.md."""

from __future__ import annotations

import importlib.util
import re

import numpy as np
import pytest
import yaml
from repository_folders import DOCS

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.config.rig import RigConfig, load_rig
from levid.config.session import SessionConfig
from levid.config.shipped import shipped
from levid.daemon.planning.plan import plan_session
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.log.importing.signals_yaml import SignalsFile
from levid.model.geometry import decoupling_matrix

PAGES = sorted(DOCS.glob("*.md"))
EXAMPLES = re.findall(r"```yaml\n(.*?)```", (DOCS / "configuration.md").read_text(), re.DOTALL)
SESSIONS = [text for text in EXAMPLES if yaml.safe_load(text)["levid"] == "session"]


def example_of(kind):
    (text,) = (t for t in EXAMPLES if yaml.safe_load(t)["levid"] == kind)
    return text


@pytest.fixture(scope="module")
def reference():
    spec = importlib.util.spec_from_file_location("make_reference", DOCS / "make_reference.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_tables_are_up_to_date(reference, page):
    text = page.read_text(encoding="utf-8")
    assert reference.with_tables(text) == text, "run python docs/make_reference.py"


def test_every_table_is_on_a_page(reference):
    shown = {
        name for page in PAGES for name in re.findall(r"<!-- table: (\S+) -->", page.read_text())
    }
    assert shown == set(reference.TABLES)


def test_every_key_has_a_description(reference):
    words = yaml.safe_load(reference.WORDS.read_text(encoding="utf-8"))
    explained = {
        kind: {name: set(keys) for name, keys in mappings.items()}
        for kind, mappings in words.items()
    }
    assert explained == {kind: reference.mappings_of(kind) for kind in reference.SCHEMAS}


@pytest.mark.parametrize("text", SESSIONS, ids=lambda t: yaml.safe_load(t)["name"])
def test_session_of_the_docs_can_be_flown_on_the_shipped_rig(text):
    session = parse_text(text, SessionConfig, "docs/configuration.md")
    plan = plan_session(session, load_rig(shipped("rigs/loopback.yaml")))
    assert plan.cycles > 0


def test_sessions_of_the_docs_cover_every_kind_of_excitation():
    names = [yaml.safe_load(text)["name"] for text in SESSIONS]
    assert names == [
        "white-noise",
        "band-limited",
        "multisine",
        "orthogonal",
        "one-coil",
        "sweep",
    ]
    (plan,) = (
        plan_session(parse_text(t, SessionConfig, "docs"), load_rig(shipped("rigs/loopback.yaml")))
        for t in SESSIONS
        if "orthogonal:" in t
    )
    (record,) = (step for step in plan.steps if step.kind == "record")
    # 3 s to settle, the periods of the page's example, 0.5 s to fade out, at 1 kHz
    assert record.cycles == (3 + 2 * 3 * 4 * 8 + 0.5) * 1000


def test_rig_of_the_docs_determines_three_dof():
    rig = parse_text(example_of("rig"), RigConfig, "docs/configuration.md")
    T = decoupling_matrix(rig.geometry.coil_x_m, rig.geometry.coil_y_m)
    S = np.stack([rig.geometry.coil_y_m, rig.geometry.coil_x_m, np.ones(3)], axis=1)
    np.testing.assert_allclose(T @ S, np.eye(3), atol=1e-12)  # rounding of a few operations


def test_model_of_the_docs_is_an_oscillator():
    config = parse_text(example_of("model"), ModelConfig, "docs/configuration.md")
    at = declared_model(config).at()
    assert (at.M.item(), at.D.item(), at.K.item()) == (1.0, 2.0, 50.0)


def test_signals_of_the_docs_have_one_input_and_one_output():
    signals = parse_text(example_of("signals"), SignalsFile, "docs/configuration.md")
    assert [c.name for c in signals.with_role("output")] == ["x_m"]
    assert [c.name for c in signals.with_role("input")] == ["u_n"]
