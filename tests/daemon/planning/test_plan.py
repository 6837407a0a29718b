"""Test plans of records with inputs in turn, scaling or rotor moves, and the trace sessions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from levid.config.base import ConfigError
from levid.config.rig import load_rig
from levid.config.session import SessionConfig, load_session
from levid.config.shipped import shipped
from levid.daemon.control.flight_segment import Segment
from levid.daemon.control.states import State
from levid.daemon.planning.plan import Plan, plan_session

RATE = 1000


def plan(record: dict[str, Any], **excitations: dict[str, Any]) -> Plan:
    config = SessionConfig.model_validate(
        {
            "levid": "session",
            "name": "turns",
            "rate_hz": RATE,
            "excitations": excitations,
            "steps": [{"levitate": {}}, {"record": {"name": "r", **record}}, {"land": {}}],
        }
    )
    return plan_session(config, load_rig(shipped("rigs/loopback.yaml")))


def flown(record: dict[str, Any], **excitations: dict[str, Any]) -> Segment:
    return plan(record, **excitations).steps[1].segments()[-1]


PSI = {"input": "psi", "rms_n_m": 0.1, "signal": "multisine", "period_s": 2, "band_hz": [1, 40]}
COIL = {"input": "coil:4", "rms_n": 1.0, "signal": "multisine", "period_s": 2, "band_hz": [1, 40]}


def test_each_excitation_plays_alone_but_for_the_fade() -> None:
    segment = flown({"excite": ["a", "b"], "each_s": 4, "fade_s": 0.5}, a=PSI, b=COIL)
    assert segment.cycles == len(segment.v) == 2 * 4000 + 500
    assert not segment.v[4500:].any()
    assert not segment.coil_excitation[:4000].any()
    assert np.flatnonzero(segment.coil_excitation.any(axis=0)).tolist() == [4]


def test_a_whole_record_has_the_beam_in_its_feed_forward_or_not() -> None:
    sweep = {"duration_s": 4, "beam": [{"to_m": 0.02}, {"to_m": 0.0}]}
    for carries in (True, False):
        steps = plan({**sweep, "beam_feedforward": carries}).steps
        kept = [[segment.beam_feedforward for segment in step.segments()] for step in steps]
        assert all(kept[0] + kept[2])
        assert kept[1] == [carries, carries]  # settling belongs to the record
        assert (steps[1].disturbing_beam is None) == carries
    with pytest.raises(ValidationError, match="beam_feedforward: expected false with a trajectory"):
        plan({"duration_s": 4, "beam_feedforward": False})


def test_last_period_of_every_turn_is_whole() -> None:
    """Full level from the end of the fade in to the end of the turn, so two periods of four agree
    where neither fades: to rounding."""
    segment = flown({"excite": ["a", "b"], "each_s": 4, "fade_s": 0.5}, a=PSI, b=COIL)
    for played, begin in ((segment.v[:, 0], 0), (segment.coil_excitation[:, 4], 4000)):
        turn = played[begin : begin + 4000]
        np.testing.assert_allclose(turn[500:2000], turn[2500:4000], rtol=1e-12)
    np.testing.assert_allclose(np.sqrt(np.mean(segment.v[2000:4000, 0] ** 2)), 0.1, rtol=1e-12)


def test_scale_multiplies_every_level() -> None:
    record = {"excite": ["a", "b"], "duration_s": 8}
    full, half = flown(record, a=PSI, b=COIL), flown({**record, "scale": 0.5}, a=PSI, b=COIL)
    np.testing.assert_array_equal(half.v, 0.5 * full.v)
    np.testing.assert_array_equal(half.coil_excitation, 0.5 * full.coil_excitation)


def test_rotor_repeats_its_waypoints_within_the_limits() -> None:
    waypoints = [
        {"to_rad": 6.0, "velocity_rad_s": 8.0, "dwell_s": 0.5},
        {"to_rad": -2.0, "acceleration_rad_s2": 50.0},
    ]
    segment = flown({"duration_s": 10, "rotor": waypoints})
    assert segment.state is State.MOVING
    assert segment.rotor.shape == (10_000, 3)
    position, speed, acceleration = segment.rotor.T
    assert (position.max(), position.min()) == (6.0, -2.0)
    # The rig's limits where none is given; 1e-9 is the quintic's rounding.
    assert np.abs(speed).max() <= 20.0 * (1 + 1e-9)
    assert np.abs(acceleration).max() <= 200.0 * (1 + 1e-9)
    assert position[-1] == pytest.approx(position[-2], abs=1e-12)
    assert np.abs(np.diff(position)).max() <= 20.0 / RATE * (1 + 1e-9)
    # Both arrive more than once in 10 s: the way there and back takes some 2 s.
    assert np.sum(np.diff((position == 6.0).astype(int)) == 1) >= 3


def test_beam_and_rotor_go_their_own_ways() -> None:
    segment = flown(
        {
            "duration_s": 6,
            "beam": [{"to_m": 0.05, "dwell_s": 0.3}, {"to_m": -0.05, "dwell_s": 0.3}],
            "rotor": [{"to_rad": 3.0, "dwell_s": 0.7}, {"to_rad": 0.0, "dwell_s": 0.2}],
        }
    )
    alone = flown(
        {
            "duration_s": 6,
            "beam": [{"to_m": 0.05, "dwell_s": 0.3}, {"to_m": -0.05, "dwell_s": 0.3}],
        }
    )
    np.testing.assert_array_equal(segment.beam, alone.beam)


@pytest.mark.parametrize(
    ("record", "message"),
    [
        ({"each_s": 2}, "expected excitations in 'excite'"),
        ({"each_s": 2, "duration_s": 4, "excite": ["a"]}, "found duration_s and each_s"),
        ({"each_s": 0.2, "excite": ["a"]}, "fade_s of at most each_s"),
        ({"excite": ["a"]}, "found none"),
        ({"duration_s": 4, "excite": ["a"], "scale": 0}, "greater than 0"),
    ],
)
def test_what_makes_no_sense_is_refused(record: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        plan(record, a=PSI)


@pytest.mark.parametrize(
    ("point", "message"),
    [
        ({"to_rad": 1, "velocity_rad_s": 1000}, r"rotor\[0\].velocity_rad_s: expected at most 20"),
        ({"to_rad": 1, "acceleration_rad_s2": 1e4}, r"acceleration_rad_s2: expected at most 200"),
        ({"to_rad": 100, "velocity_rad_s": 1}, r"rotor\[0\].to_rad: expected a move within"),
    ],
)
def test_rotor_beyond_the_rig_is_refused(point: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        plan({"duration_s": 4, "rotor": [point]})


@pytest.mark.parametrize("name", ["trace", "trace-short"])
def test_trace_sessions_hold_what_tracing_needs(name: str) -> None:
    """Every input and every coil, two amplitudes, three places, sweeps, stillness, rotor."""
    session = load_session(shipped(f"sessions/{name}.yaml"))
    rig = load_rig(shipped("rigs/loopback.yaml"))
    flight = plan_session(session, rig)
    records = [step.record for step in session.steps if step.record is not None]
    inputs = {session.excitations[name].input for record in records for name in record.excite}
    assert inputs == {"psi", "theta", "z", *(f"coil:{i}" for i in range(9))}
    assert all(e.signal == "multisine" for e in session.excitations.values())

    played = {}
    for step, planned in zip(session.steps, flight.steps, strict=True):
        if step.record is not None and step.record.excite and not step.record.beam:
            at = float(planned.segments()[-1].beam[0, 0])
            played.setdefault(at, set()).add((step.record.excite[0], step.record.scale))
    assert set(played) == {-0.1, 0.0, 0.1}
    assert {scale for what in played.values() for _, scale in what} == {0.5, 1.0}
    if name == "trace":
        everything = {(first, scale) for first in ("psi", "coil-0") for scale in (0.5, 1.0)}
        assert all(what == everything for what in played.values())

    assert any(record.beam and record.excite and record.rotor for record in records)
    assert any(record.beam and not record.excite for record in records)
    still = [not (record.excite or record.beam or record.rotor) for record in records]
    assert still[0]
    assert still[-1]
    assert session.then == ("identify", "trace")
    minutes = flight.cycles / flight.rate_hz / 60
    assert minutes < {"trace": 20, "trace-short": 6}[name]
