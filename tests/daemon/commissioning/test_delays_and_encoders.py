"""Test how late devices answer, and encoders that are measured by hand."""

from __future__ import annotations

import io
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from levid.benchmarks.daemon.commissioned_rigs import (
    FORCE_N,
    STOPS,
    Wiring,
    commissioned,
    rig_file,
)
from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.commissioning import answer_delays
from levid.daemon.commissioning.answer_delays import (
    Delay,
    delay_of_moves,
    delay_of_swings,
    swings,
)
from levid.daemon.commissioning.commission import commission
from levid.daemon.commissioning.corrections import problems, remarks
from levid.daemon.commissioning.device_session import DeviceSession
from levid.daemon.planning import point_to_point
from levid.drivers.base import Context
from levid.drivers.loopback import LoopbackBackend

TS_S = 1e-3


def answers(delay_s: float, lag_s: float, noise: float, seed: int) -> answer_delays.Swings:
    """Ten answers from 1 to -1, of a size and sign of their own, with noise."""
    rng = np.random.default_rng(seed)
    t = TS_S * np.arange(100)
    size = rng.uniform(0.3, 1.0, 10) * rng.choice([-1.0, 1.0], 10)
    after = np.clip(t + TS_S - delay_s, 0.0, None)
    share = 1.0 - 2.0 * (1.0 - np.exp(-after / lag_s))
    y = size[:, None] * share + noise * rng.standard_normal((10, 100))
    return swings(y, size + noise / np.sqrt(25) * rng.standard_normal(10), TS_S)


def test_delay_of_a_lag_and_a_dead_time() -> None:
    # Two samples before it decays, each to exp(-1 / 3) of the last one, settled to exp(-50 / 3).
    found = delay_of_swings([answers(2e-3, 3e-3, 0.0, k) for k in range(3)])
    decay = np.exp(-TS_S / 3e-3)
    assert found.mean_s == pytest.approx(TS_S + TS_S / (1.0 - decay), rel=1e-4)
    assert found.sd_s < 1e-9


def test_delay_is_within_its_own_uncertainty_over_many_seeds() -> None:
    truth = delay_of_swings([answers(2e-3, 3e-3, 0.0, 0)]).mean_s
    z = []
    for seed in range(300):
        found = delay_of_swings([answers(2e-3, 3e-3, 0.05, 10 * seed + k) for k in range(9)])
        z.append((found.mean_s - truth) / found.sd_s)
    # 300 normal numbers: mean within 4 of its errors; a spread within 4 of its own, 1 / sqrt(600).
    assert abs(np.mean(z)) < 4 / np.sqrt(300)
    assert abs(np.std(z) - 1.0) < 4 / np.sqrt(600)


def test_delay_of_drives_that_follow_late() -> None:
    moves = []
    for begin, end in ((0.0, 0.02), (0.02, 0.0)):
        position, velocity, _ = point_to_point.move(begin, end, 0.05, 0.5, TS_S).T
        late = np.concatenate([np.full(4, begin), position[:-4]])
        moves.append(np.stack([position, velocity, late], axis=1))
    # A smooth move of 0.6 s: four periods are short against it.
    assert delay_of_moves(moves).mean_s == pytest.approx(4e-3, rel=0.01)


def test_delays_of_the_simulated_rig(tmp_path: Path) -> None:
    rig, found = commissioned(tmp_path, "loopback", Wiring(), 1)
    # One cycle until it acts, one until its end is read, the current loop's lag of 0.3 ms, and the
    # rise of the stops.
    assert 2e-3 < found.height_delay.mean_s < 3e-3
    assert not [line for line in remarks(found, rig) if "heights answer" in line]
    late = replace(found, height_delay=Delay(6e-3, 1e-4))
    (line,) = [line for line in remarks(late, rig) if "heights answer" in line]
    assert "6 ms" in line
    assert "2.3 ms" in line


@pytest.mark.parametrize(
    ("beam", "rotor", "words"),
    [
        (1.02, 0.98, []),
        (None, 1.0, []),
        (2.0, -1.0, ["beam moves 2 times as far", "rotor moves the wrong way"]),
    ],
)
def test_encoders_are_what_the_operator_measures(
    tmp_path: Path, beam: float | None, rotor: float, words: list[str]
) -> None:
    path = rig_file(tmp_path, "loopback", Wiring(), 3)
    rig = load_rig(path)
    asked = []

    def measure(axis: str, way: float) -> Future[float | None]:
        asked.append((axis, way))
        answer: Future[float | None] = Future()
        factor = beam if axis == "beam" else rotor
        answer.set_result(None if factor is None else factor * way)
        return answer

    with DeviceSession(Context(rig, 1e-3, tmp_path), FORCE_N, FORCE_N) as session:
        (backend,) = session.devices.backends
        assert isinstance(backend, LoopbackBackend)
        found = commission(
            session, rig, STOPS, FORCE_N, backend.lift, lambda *_: None, 0.02, measure
        )
        assert session.rotor_rad == pytest.approx(0.0, abs=1e-6)
        assert session.beam_m == pytest.approx(0.0, abs=1e-6)
    assert asked == [("beam", 0.02), ("rotor", pytest.approx(np.pi / 6))]
    assert found.beam_delay is not None
    assert found.beam_delay.mean_s == pytest.approx(2e-3, abs=1e-4)
    said = problems(found)
    assert len(said) == len(words)
    assert all(word in line for word, line in zip(words, said, strict=True))
    unmeasured = [line for line in remarks(found, rig) if "not measured by hand" in line]
    assert len(unmeasured) == (beam is None)


def test_command_asks_for_what_is_measured(levid, tmp_path: Path, monkeypatch) -> None:
    path = rig_file(tmp_path, "loopback", Wiring(), 3)
    text = shipped("rigs/loopback.yaml").read_text()
    text = text.replace("../models/rig.yaml", str(shipped("models/rig.yaml")))
    path.write_text(text.replace("../sims/nominal.yaml", "sim.yaml"))
    monkeypatch.setattr("sys.stdin", io.StringIO("20.5\nnobody\n"))
    outcome = levid("commission", path, "--out", tmp_path / "new.yaml", "--measure")
    assert outcome.code == 0, outcome.out
    assert "The encoder reports that the beam moved by 20 mm." in outcome.err
    assert "the motion of the rotor was not measured by hand" in outcome.out
    assert "the heights follow a coil's command after 2.5" in outcome.out
