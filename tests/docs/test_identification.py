"""Test docs/identification.md: its Python code runs on a short flight and finds the plant."""

from __future__ import annotations

import re

import numpy as np
import pytest
from repository_folders import DOCS

from levid.config.base import load_yaml, parse_text
from levid.config.rig import load_rig
from levid.config.session import SessionConfig
from levid.config.shipped import shipped
from levid.config.sim import SimConfig
from levid.daemon.loop.virtual_session import fly_virtually
from levid.sim.true_response import frequency_response

DOC = (DOCS / "identification.md").read_text()
PLANT, FIT, CONTROL = re.findall(r"```python\n(.*?)```", DOC, re.DOTALL)
SESSION = """
levid: session
name: short
rate_hz: 500
seed: 3
excitations:
  psi: {input: psi, rms_n_m: 0.1}
  theta: {input: theta, rms_n_m: 0.1}
  z: {input: z, rms_n: 1.3}
steps:
  - levitate: {settle_s: 1}
  - record: {name: psi, duration_s: 9, excite: [psi]}
  - record: {name: theta, duration_s: 9, excite: [theta]}
  - record: {name: z, duration_s: 9, excite: [z]}
  - land: {}
"""


@pytest.fixture(scope="module")
def variables(tmp_path_factory):
    """Return the variables after the first snippet."""
    folder = tmp_path_factory.mktemp("docs")
    rig_file = shipped("rigs/loopback.yaml")
    session = parse_text(SESSION, SessionConfig, "short")
    fly_virtually(load_rig(rig_file), rig_file, session, SESSION.encode(), folder / "out" / "first")
    found = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        exec(compile(PLANT, "identification.md", "exec"), found)
    return found


def test_first_snippet_finds_the_plant(variables):
    (point,) = variables["result"].points
    sim = load_yaml(shipped("sims/nominal.yaml"), SimConfig)
    freq_hz = np.array([2.0, 8.0, 32.0])
    true = frequency_response(sim, 0.0, freq_hz, 500.0)
    found = point.plant.response(freq_hz)
    for i in range(3):
        # Records of 9 s determine it to about 10 %; a wrong delay or unit gives a far larger error.
        np.testing.assert_allclose(found[:, i, i], true[:, i, i], rtol=0.3)
    assert variables["spread"].shape == variables["P"].shape == (len(point.freq_hz), 3, 3)
    assert variables["model"].dt == 2e-3
    assert len(variables["left_out"]) == 2  # levitate, land


def test_second_snippet_fits_the_declared_model(variables, capsys):
    exec(compile(FIT, "identification.md", "exec"), variables)
    fit = variables["fit"]
    # Nominal mass 5.6 kg; 27 s of records determine it to 0.5 g; ten times that is a wide margin.
    assert fit.values["m_p"] == pytest.approx(5.6, abs=0.005)
    # As the page says, m_b and z_b are not identifiable with the beam at rest in the middle.
    assert {u.name for u in fit.unidentifiable} == {"m_b", "z_b"}
    assert "z_b cannot be identified" in capsys.readouterr().out
    assert variables["at"].M[1, 2] == pytest.approx(1.4 * 0.05)


def test_third_snippet_gives_a_python_control_system(variables):
    pytest.importorskip("control")
    exec(compile(CONTROL, "identification.md", "exec"), variables)
    assert (
        variables["plant"].nstates == 12
    )  # six states, and two cycles of delay for each of three inputs
