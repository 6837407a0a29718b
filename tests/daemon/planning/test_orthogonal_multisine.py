"""Test orthogonal multisines: unitary at every line, periodic, equal lines in a session."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest
import yaml

from levid.config.base import ConfigError, parse_text
from levid.config.rig import load_rig
from levid.config.session import Excitation, Orthogonal, SessionConfig
from levid.config.shipped import shipped
from levid.daemon.planning.excitation import excited_lines
from levid.daemon.planning.orthogonal_multisine import orthogonal_matrix, orthogonal_multisines
from levid.daemon.planning.plan import plan_session

RATE_HZ, PERIOD_S, PERIODS = 500.0, 2.0, 3
N = 1000
LEVELS = (0.1, 0.2, 1.5)


def excitation(number: int = 0, **more: object) -> Excitation:
    level = {"rms_n": LEVELS[2]} if number == 2 else {"rms_n_m": LEVELS[number]}
    text = {
        "input": ("psi", "theta", "z")[number],
        "signal": "multisine",
        "period_s": PERIOD_S,
        "band_hz": [1.0, 60.0],
        "lines": "odd_random_grid",
        **level,
    }
    return Excitation.model_validate({**text, **more})


def played(p: int, seed: int = 1, record: int = 5, **more: object) -> np.ndarray:
    """Two realisations as (realisation, experiment, period, sample, input)."""
    periods = orthogonal_multisines(
        [excitation(j, **more) for j in range(p)],
        Orthogonal(realisations=2, periods=PERIODS),
        RATE_HZ,
        seed,
        record,
    )
    found = list(islice(periods, 2 * p * PERIODS + 1))
    np.testing.assert_array_equal(found.pop(), found[-1])  # while it fades out
    return np.concatenate(found).reshape(2, p, PERIODS, N, p)


@pytest.mark.parametrize("p", [1, 2, 3])
def test_experiments_are_a_unitary_matrix_at_every_line(p: int) -> None:
    v = played(p)
    V = np.fft.rfft(v[:, :, 0], axis=2) * np.sqrt(2) / N
    power = np.einsum("rekj,rekl->rkjl", V, V.conj())
    excited = np.einsum("rkjj->k", power).real > 1e-20
    lines = np.flatnonzero(excited)
    assert np.all(lines % 2 == 1)
    # Each input plays its mean square in equal parts at the lines, in every one of p experiments.
    wanted = p * np.diag(np.square(LEVELS[:p])) / len(lines)
    np.testing.assert_allclose(power[:, excited], np.broadcast_to(wanted, (2, len(lines), p, p)),
                               atol=1e-12)  # fmt: skip
    assert abs(V[:, :, ~excited]).max() < 1e-14


def test_periods_repeat_and_realisations_differ() -> None:
    v = played(3)
    np.testing.assert_array_equal(v[:, :, 1:], v[:, :, :-1])
    # With random phases at 45 lines correlations scatter by 1 / sqrt(90): five of that.
    for other in (v[1, 0], played(3, record=6)[0, 0], played(3, seed=2)[0, 0], v[0, 1]):
        r = np.corrcoef(v[0, 0, 0, :, 0], other[0, :, 0])[0, 1]
        assert abs(r) < 0.53
    np.testing.assert_array_equal(v, played(3))


def test_lines_are_those_of_the_session_in_every_record() -> None:
    def lines(seed: int, record: int) -> np.ndarray:
        return np.flatnonzero(abs(np.fft.rfft(played(2, seed, record)[0, 0, 0, :, 0])) > 1e-9)

    np.testing.assert_array_equal(lines(1, 3), lines(1, 8))
    assert not np.array_equal(lines(1, 3), lines(2, 3))


def test_random_grid_leaves_out_one_odd_line_of_four() -> None:
    lines = excited_lines(excitation(), RATE_HZ, np.random.default_rng(1))
    odd = np.arange(3, 121, 2)  # of 0.5 Hz each, from 1 to 60 Hz
    missing = np.setdiff1d(odd, lines)
    np.testing.assert_array_equal(np.searchsorted(odd, missing) // 4, np.arange(len(odd) // 4))
    assert set(lines) < set(odd)


def test_lines_rise_with_frequency_above_rise_hz() -> None:
    v = played(1, rise_hz=10.0)[0, 0, 0, :, 0]
    size = abs(np.fft.rfft(v))
    lines = np.flatnonzero(size > 1e-9)
    freq_hz = lines / PERIOD_S
    np.testing.assert_allclose(
        size[lines] / size[lines[0]], np.maximum(freq_hz / 10.0, 1.0), rtol=1e-10
    )
    np.testing.assert_allclose(np.sqrt(np.mean(v**2)), LEVELS[0], rtol=1e-12)


@pytest.mark.parametrize("p", [1, 2, 3, 4, 5, 8, 9])
def test_orthogonal_matrix_is_unitary_with_entries_of_one_size(p: int) -> None:
    W = orthogonal_matrix(p)
    np.testing.assert_allclose(W @ W.conj().T, p * np.eye(p), atol=1e-12)
    np.testing.assert_allclose(abs(W), 1.0, rtol=1e-12)
    if p in (2, 4, 8):
        assert np.all(W.imag == 0)  # Hadamard: signs alone


SESSION = """
levid: session
name: multisine
excitations:
  psi: {input: psi, rms_n_m: 0.03, signal: multisine, period_s: 2, band_hz: [1, 60]}
  z: {input: z, rms_n: 0.3, signal: multisine, period_s: 2, band_hz: [1, 60]}
  noise: {input: theta, rms_n_m: 0.03}
steps:
  - levitate: {}
  - record: {name: both, excite: [psi, z], orthogonal: {realisations: 2, periods: 3}}
  - land: {}
"""


def changed(record: dict[str, object] | None = None, **excitations: object) -> SessionConfig:
    data = yaml.safe_load(SESSION)
    data["steps"][1]["record"].update(record or {})
    for name, keys in excitations.items():
        data["excitations"][name].update(keys)
    return parse_text(yaml.safe_dump(data), SessionConfig, "session")


def test_a_record_fades_within_its_first_period_and_after_its_last() -> None:
    step = plan_session(changed(), load_rig(shipped("rigs/loopback.yaml"))).steps[1]
    settle, excited = step.segments()
    assert settle.cycles == 3000
    assert excited.cycles == 2 * 2 * 3 * 2000 + 500
    np.testing.assert_array_equal(excited.v[:, 1], 0.0)
    v = excited.v[:24_000].reshape(4, 3, 2000, 3)
    np.testing.assert_array_equal(v[1:, 0], v[1:, 2])  # nothing but the first 0.5 s fades
    np.testing.assert_array_equal(v[:, 1], v[:, 2])
    assert np.abs(v[0, 0, 0]).max() == np.abs(excited.v[-1]).max() == 0.0


@pytest.mark.parametrize(
    ("record", "excitations", "message"),
    [
        ({"duration_s": 10}, {}, "exactly one of duration_s, orthogonal"),
        ({"orthogonal": None}, {}, "exactly one of duration_s, orthogonal"),
        ({"excite": []}, {}, "expected multisines in 'excite'"),
        ({"excite": ["psi", "noise"]}, {}, "multisines only, found 'noise' with signal white_n"),
        ({}, {"z": {"period_s": 4}}, "the same period_s .* 2.0 in 'psi' and 4.0 in 'z'"),
        ({}, {"z": {"band_hz": [1, 50]}}, "the same band_hz in all"),
        ({}, {"z": {"lines": "odd"}}, "the same lines in all .* 'all' in 'psi' and 'odd' in 'z'"),
        ({"excite": ["psi", "psi"]}, {}, "a different input for each excitation"),
        ({"fade_s": 3.0}, {}, "fade_s: expected at most one period, 2 s, found 3 s"),
        ({"beam": [{"to_m": 0.1}]}, {}, "expected no trajectory"),
        (
            {"orthogonal": {"realisations": 2, "periods": 2}},
            {},
            "periods: expected a number of at least 3",
        ),
        ({}, {"noise": {"rise_hz": 10}}, "rise_hz: expected with signal multisine only, found 10"),
    ],
)
def test_what_cannot_be_played_is_refused(
    record: dict[str, object], excitations: dict[str, object], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        changed(record, **excitations)


def test_a_band_without_lines_is_refused_by_name() -> None:
    session = changed({}, psi={"band_hz": [1.1, 1.2]}, z={"band_hz": [1.1, 1.2]})
    with pytest.raises(ConfigError, match=r"excitations.psi.band_hz: .* at least one multiple"):
        plan_session(session, load_rig(shipped("rigs/loopback.yaml")))


def test_the_shipped_session_excites_what_its_comment_says() -> None:
    session = parse_text(
        shipped("sessions/multisine-1khz.yaml").read_bytes(), SessionConfig, "session"
    )
    rig = load_rig(shipped("rigs/loopback.yaml"))
    plan = plan_session(session, rig)
    # 3 positions x 3 realisations x 3 experiments x 4 periods of 8 s, and moving about.
    assert 864 < plan.cycles / plan.rate_hz < 920
