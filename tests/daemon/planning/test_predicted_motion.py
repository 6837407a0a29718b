"""Test the predicted motion of a session against a flight, and where it must refuse."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from levid.config.base import parse_text
from levid.config.rig import FeedForward, RigConfig, load_rig
from levid.config.session import SessionConfig, load_session
from levid.config.shipped import shipped
from levid.daemon.control.states import State
from levid.daemon.loop.virtual_session import fly_virtually
from levid.daemon.planning.plan import plan_session
from levid.daemon.planning.planner import Planner
from levid.daemon.planning.predicted_motion import motion_finding, predicted_motion
from levid.daemon.planning.refused_request import RefusedError, Situation
from levid.log.reader import read_log

RIG_FILE = shipped("rigs/loopback.yaml")
SESSION = """
levid: session
name: short
excitations:
  psi: {input: psi, rms_n_m: 0.2}
  z: {input: z, rms_n: 2.0, band_hz: [1, 100]}
steps:
  - levitate: {}
  - record: {name: tilt, duration_s: 4, settle_s: 0.5, excite: [psi]}
  - move: {beam_m: 0.08}
  - record: {name: both, duration_s: 4, settle_s: 0.5, excite: [psi, z]}
  - land: {}
"""


@pytest.fixture(scope="module")
def rig() -> RigConfig:
    return load_rig(RIG_FILE)


def test_prediction_is_what_the_simulated_rig_does(rig: RigConfig, tmp_path: Path) -> None:
    session = parse_text(SESSION, SessionConfig, "session")
    found = predicted_motion(rig, plan_session(session, rig))
    assert found is not None
    flown = fly_virtually(rig, RIG_FILE, session, SESSION.encode(), tmp_path, lambda *_: None)
    gap, tilt = {}, {}
    for path in flown.records:
        log = read_log(path)
        gap[path.stem[3:]] = float(np.abs(log.field("gap_m")).max())
        tilt[path.stem[3:]] = max(
            float(np.abs(log.field(f"{dof}_rad")).max()) for dof in ("psi", "theta")
        )
    assert found.gap_step == max(gap, key=gap.__getitem__) == "both"
    # The simulated plant is nonlinear and has noise of 0.1 um; its parameters are the model's.
    assert found.gap_m == pytest.approx(gap["both"], rel=0.05)
    assert found.tilt_rad == pytest.approx(max(tilt.values()), rel=0.05)


def test_a_session_that_leaves_the_range_is_refused_unless_overridden(rig: RigConfig) -> None:
    loud = SESSION.replace("rms_n: 2.0, band_hz: [1, 100]", "rms_n: 9.0, band_hz: [1, 12]")
    finding = motion_finding(rig, plan_session(parse_text(loud, SessionConfig, "session"), rig))
    assert finding.failed
    assert "of 0.85 mm" in finding.found
    assert "step both" in finding.remedy
    request = {"op": "excite", "out": "x", "session": loud}
    planner, rest = Planner(rig), Situation(State.IDLE)
    with pytest.raises(RefusedError, match=r"not ready to lift off: motion: .*--override motion"):
        planner.plan(json.dumps(request).encode(), rest)
    with pytest.raises(RefusedError, match=r"override: expected one of devices.*found 'noise'"):
        planner.plan(json.dumps({**request, "override": ["noise"]}).encode(), rest)
    planned = planner.plan(json.dumps({**request, "override": ["motion"]}).encode(), rest)
    assert planned.override == ("motion",)
    assert "overridden by the client: motion" in planned.note


def test_a_session_without_excitation_passes(rig: RigConfig) -> None:
    quiet = parse_text(shipped("sessions/beam.yaml").read_text(), SessionConfig, "beam")
    finding = motion_finding(rig, plan_session(quiet, rig))
    assert (finding.outcome, finding.found) == ("passed", "no excitation")


SWEEP = """
levid: session
name: sweep
steps:
  - levitate: {settle_s: 1}
  - move: {beam_m: 0.02, settle_s: 2}
  - record:
      name: sweep
      duration_s: 4
      settle_s: 0.5
      beam_feedforward: false
      beam: [{to_m: -0.02, velocity_m_s: 0.3, acceleration_m_s2: 3, dwell_s: 0.4}, {to_m: 0.02}]
  - land: {}
"""


def test_a_beam_that_the_feed_forward_does_not_carry_is_predicted(
    rig: RigConfig, tmp_path: Path
) -> None:
    session = parse_text(SWEEP, SessionConfig, "session")
    found = predicted_motion(rig, plan_session(session, rig))
    assert found is not None
    flown = fly_virtually(rig, RIG_FILE, session, SWEEP.encode(), tmp_path, lambda *_: None)
    log = read_log(flown.records[0])
    gap_m, tilt_rad = np.abs(log.field("gap_m")).max(), np.abs(log.field("theta_rad")).max()
    # The prediction has the inertia of the beam at its start.
    assert found.gap_m == pytest.approx(float(gap_m), rel=0.05)
    assert found.tilt_rad == pytest.approx(float(tilt_rad), rel=0.05)
    assert found.tilt_rad > 2e-3

    # Of the beam's 0.27 N m at its start no hundredth comes as a step, at either end of the record.
    steps = [read_log(path).field("tau_theta_n_m") for path in flown.logs]
    ends = [abs(after[0] - before[-1]) for before, after in pairwise(steps)]
    assert max(ends[1:]) < 2.7e-3
    feed_forward = log.field("ff_theta_n_m")
    assert np.all(feed_forward == feed_forward[0])
    assert abs(feed_forward[0]) < 0.01  # the platform's own, of k_thetaz
    assert np.abs(read_log(flown.logs[-1]).field("ff_theta_n_m")).max() > 0.2


def test_a_sweep_that_leaves_the_range_is_refused(rig: RigConfig) -> None:
    far = SWEEP.replace("0.02", "0.09")
    finding = motion_finding(rig, plan_session(parse_text(far, SessionConfig, "session"), rig))
    assert finding.failed
    assert "step sweep: move the beam less far" in finding.remedy
    carried = far.replace("beam_feedforward: false", "beam_feedforward: true")
    finding = motion_finding(rig, plan_session(parse_text(carried, SessionConfig, "session"), rig))
    assert (finding.outcome, finding.found) == ("passed", "no excitation")


def test_the_sweep_of_the_papers_figures_stays_within_a_shipped_sessions_range(
    rig: RigConfig,
) -> None:
    session = load_session(shipped("sessions/paper-figures.yaml"))
    found = predicted_motion(rig, plan_session(session, rig))
    assert found is not None
    assert found.disturbed == ("sweep-without-ff",)
    assert found.gap_m < 0.6e-3  # as docs/configuration.md says of all
    assert found.gap_m * 1.4 < rig.limits.gap_m


def test_nothing_is_said_of_a_rig_without_a_model(rig: RigConfig) -> None:
    own = FeedForward(mass_kg=7.0, beam_mass_kg=1.4, rods_n_m=1000.0)
    bare = rig.model_copy(update={"model": None, "feedforward": own})
    plan = plan_session(parse_text(SESSION, SessionConfig, "session"), bare)
    assert motion_finding(bare, plan).outcome == "unknown"
