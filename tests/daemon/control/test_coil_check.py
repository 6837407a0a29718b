"""Test the coil check after lift-off: sound coils pass on any plant; faulty coils are named."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml

from levid.config.base import ConfigError, parse_text
from levid.config.rig import RigConfig, load_rig
from levid.config.session import CoilCheck, Levitate, SessionConfig, Step
from levid.config.shipped import shipped
from levid.daemon.control.coil_check import Pushes, coil_check
from levid.daemon.control.faults import Fault, FlightFault
from levid.daemon.loop.virtual_session import fly_virtually
from levid.daemon.planning.plan import plan_session, plan_steps
from levid.log.reader import read_log
from levid.log.signals import Stale
from levid.model.geometry import shape_matrix

RIG_FILE = shipped("rigs/loopback.yaml")

COILS = """
import numpy as np

class Wired:
    def __init__(self, order, gain):
        self.order, self.gain = list(order), np.array(gain, float)

    def reset(self, plant):
        pass

    def coil_force(self, t_s, q, force_n):
        return force_n[self.order] * self.gain
"""


def fly(folder: Path, sim: Path, rate_hz: float, **check: float) -> np.ndarray:
    session = {
        "levid": "session",
        "name": "check",
        "rate_hz": rate_hz,
        "steps": [
            {"levitate": {"ramp_s": 1.5, "check_coils": check, "settle_s": 0.5}},
            {"land": {"ramp_s": 0.3, "release_s": 0.2}},
        ],
    }
    text = yaml.safe_dump(session)
    rig = load_rig(RIG_FILE).model_copy(update={"sim": str(sim)})
    config = parse_text(text, SessionConfig, "check")
    result = fly_virtually(rig, RIG_FILE, config, text.encode(), folder / "out")
    return read_log(result.logs[0]).rows


def wired(folder: Path, order: list[int], gain: list[float]) -> Path:
    (folder / "coils.py").write_text(COILS)
    plain = yaml.safe_load(shipped("sims/nominal.yaml").read_text())
    plain["effects"] = [{"use": "coils.py:Wired", "order": order, "gain": gain}]
    path = folder / "sim.yaml"
    path.write_text(yaml.safe_dump(plain))
    return path


@pytest.mark.parametrize("rate_hz", [250.0, 1000.0, 10_000.0])
@pytest.mark.parametrize("sim", ["nominal", "rig", "undeclared"])
def test_sound_coils_pass(tmp_path: Path, sim: str, rate_hz: float) -> None:
    rows = fly(tmp_path, shipped(f"sims/{sim}.yaml"), rate_hz)
    assert rows["fault"].max() == 0
    assert (np.abs(rows["coil_excitation_n"]).max(axis=0) == 1.0).all()  # each was pushed
    # The push is small: the gap stays within the range of usual excitation.
    pushed = rows[rows["coil_excitation_n"].any(axis=1)]
    assert np.abs(pushed["gap_m"]).max() < 3e-4


@pytest.mark.parametrize(
    ("order", "gain", "named"),
    [
        ([0, 1, 2, 3, 4, 5, 6, 7, 8], {5: 0.7}, ["coil 5"]),
        ([0, 1, 2, 3, 4, 5, 6, 7, 8], {8: 1.3, 4: 0.6}, ["coil 4", "coil 8"]),
        ([0, 1, 2, 3, 4, 5, 8, 7, 6], {}, ["coil 6", "coil 8"]),
        ([0, 2, 1, 3, 4, 5, 6, 7, 8], {}, ["coil 1", "coil 2"]),
    ],
)
def test_coil_that_moves_other_sensors_is_named(
    tmp_path: Path, order: list[int], gain: dict[int, float], named: list[str]
) -> None:
    gains = [gain.get(i, 1.0) for i in range(9)]
    with pytest.raises(FlightFault) as caught:
        fly(tmp_path, wired(tmp_path, order, gains), 1000.0)
    assert caught.value.fault is Fault.COIL_CHECK
    words = caught.value.detail
    assert [f"coil {i}" for i in range(9) if f"coil {i} moved" in words] == named
    rows = read_log(tmp_path / "out" / "00-levitate.mcap").rows
    at = int(np.flatnonzero(rows["fault"])[0])
    assert not rows["coil_n"][at:].any()


def test_check_that_outlasts_the_rows_kept_is_refused(tmp_path: Path) -> None:
    rig = load_rig(RIG_FILE)
    for pause_s, before_fault_s, rate_hz, seconds in (
        (3.0, 10.0, 10_000.0, r"23\.0 s, found 27\.3 s"),
        (1.5, 0.1, 10_000.0, r"13\.1 s, found 13\.8 s"),
        # Of a slow loop 4096 rows are kept.
        (5.0, 0.1, 115.0, r"33\.6 s, found 45\.3 s"),
    ):
        recording = rig.recording.model_copy(update={"before_fault_s": before_fault_s})
        slow = rig.model_copy(update={"recording": recording})
        steps = f"[{{levitate: {{check_coils: {{pause_s: {pause_s}}}}}}}, {{land: {{}}}}]"
        text = f"{{levid: session, name: x, rate_hz: {rate_hz}, steps: {steps}}}"
        config = parse_text(text, SessionConfig, "x")
        with pytest.raises(ConfigError, match=rf"steps\[0\].levitate.check_coils: .* {seconds}"):
            plan_session(config, slow)


def test_push_shorter_than_a_cycle_is_refused() -> None:
    rig = load_rig(RIG_FILE)
    for rate_hz, push_s in ((100.0, 0.008), (50.0, 0.015)):
        steps = f"[{{levitate: {{check_coils: {{push_s: {push_s}}}}}}}, {{land: {{}}}}]"
        text = f"{{levid: session, name: x, rate_hz: {rate_hz}, steps: {steps}}}"
        config = parse_text(text, SessionConfig, "x")
        with pytest.raises(ConfigError, match=r"check_coils.push_s: expected .* at least one per"):
            plan_session(config, rig)


def test_push_is_whole_cycles_at_every_rate_and_nearly_as_long_as_asked() -> None:
    """A push as long as a period or more is possible at every rate."""
    check = CoilCheck()
    for rate_hz in np.geomspace(50.0, 10_000.0, 20_000):
        push, asked = Pushes.of(check, 9, rate_hz).push, check.push_s * rate_hz
        # From 1.5 to 2 cycles, or from 1.5 to 1.
        assert 2 / 3 <= push / asked <= 4 / 3 or push == 1


@pytest.mark.parametrize("rate_hz", [113, 114, 188, 227, 313, 340, 438, 454, 10_000])
def test_check_is_planned_at_every_rate_whose_period_is_no_longer_than_a_push(
    rate_hz: int,
) -> None:
    rig = load_rig(RIG_FILE).model_copy(update={"rate_hz": float(rate_hz)})
    if rate_hz < 114:
        with pytest.raises(ConfigError, match="expected a push of at least one period"):
            planned_check(rig)
    else:
        assert planned_check(rig).push == max(round(0.008 * rate_hz), 1)


def planned_check(rig: RigConfig) -> Pushes:
    plan = plan_steps([Step(levitate=Levitate())], "levitate", rig, 0.0, 0.0, CoilCheck())
    return next(s.checks for s in plan.steps[0].segments() if s.checks is not None)


@pytest.mark.parametrize(("gain", "error"), [(1.0, ""), (0.7, "coil 5 moved the platform")])
def test_check_judges_coils_by_a_push_that_rounding_lengthened_most(
    tmp_path: Path, gain: float, error: str
) -> None:
    gains = [1.0] * 9
    gains[5] = gain
    sim = wired(tmp_path, list(range(9)), gains)
    if error:
        with pytest.raises(FlightFault, match=error):
            fly(tmp_path, sim, 188.0)
    else:
        fly(tmp_path, sim, 188.0)


def test_default_check_applies_only_if_the_session_does_not_decide() -> None:
    rig, found = load_rig(RIG_FILE), []
    for given in ("", "check_coils: false", "check_coils: {push_n: 2}"):
        text = f"{{levid: session, name: x, steps: [{{levitate: {{{given}}}}}, {{land: {{}}}}]}}"
        config = parse_text(text, SessionConfig, "x")
        for check in (None, CoilCheck()):
            segments = plan_session(config, rig, check=check).steps[0].segments()
            found.append([s.checks.force_n for s in segments if s.checks is not None])
    assert found == [[], [1.0], [], [], [2.0], [2.0]]


def test_long_check_is_evaluated_with_all_its_rows(tmp_path: Path) -> None:
    # Nine turns of 0.562 s: 5.1 s, of 23 s that there may be.
    rows = fly(tmp_path, shipped("sims/nominal.yaml"), 4500.0, pause_s=0.53)
    assert rows["fault"].max() == 0
    assert (np.abs(rows["coil_excitation_n"]).max(axis=0) == 1.0).all()


def test_push_that_a_coil_cannot_carry_is_refused(tmp_path: Path) -> None:
    rig = load_rig(RIG_FILE)
    weak = rig.model_copy(update={"limits": rig.limits.model_copy(update={"coil_n": 12.0})})
    steps = "[{levitate: {check_coils: {push_n: 5}}}, {land: {}}]"
    text = f"{{levid: session, name: x, steps: {steps}}}"
    config = parse_text(text, SessionConfig, "x")
    with pytest.raises(ConfigError, match=r"steps\[0\].levitate.check_coils.*saturate"):
        fly_virtually(weak, RIG_FILE, config, text.encode(), tmp_path / "out")


CHECK_ROWS = np.dtype(
    [("cycle", "<u8"), ("stale", "<u4"), ("coil_excitation_n", "<f4", (9,))]
    + [(name, "<f8") for name in ("psi_rad", "theta_rad", "z_m")]
)


def undisturbed_rows(pushes: Pushes) -> np.ndarray:
    """Rows of a check on a mass that moves as the geometry says."""
    excitation = pushes.excitation()
    rows = np.zeros(len(excitation) + 10, CHECK_ROWS)
    rows["cycle"] = np.arange(len(rows))
    rows["coil_excitation_n"][: len(excitation)] = excitation
    geometry = load_rig(RIG_FILE).geometry
    wrench = rows["coil_excitation_n"] @ shape_matrix(geometry.coil_x_m, geometry.coil_y_m)
    position = np.zeros_like(wrench)
    position[2:] = np.cumsum(np.cumsum(wrench, axis=0), axis=0)[:-2]
    for i, name in enumerate(("psi_rad", "theta_rad", "z_m")):
        rows[name] = 1e-9 * position[:, i]
    return rows


def late_every(rows: np.ndarray, turn: int, push: int) -> None:
    for coil in range(9):
        rows["cycle"][coil * turn + 5 :] += 2 * push


def silent_in_turn_4(rows: np.ndarray, turn: int, _: int) -> None:
    rows["stale"][4 * turn : 4 * turn + 5] = int(Stale.AMPLIFIERS)


def blind_in_turn_8(rows: np.ndarray, turn: int, _: int) -> None:
    rows["stale"][8 * turn : 9 * turn] = int(Stale.SENSORS)


@pytest.mark.parametrize(
    ("disturb", "sentence"),
    [
        (lambda *_: None, ""),
        (
            late_every,
            "coil check skipped for all 9 coils: 9 cycles were late. This is not a coil fault; let "
            "the daemon have the processors for itself. The next lift-off repeats the check",
        ),
        (
            silent_in_turn_4,
            "coil check skipped for coils 4, 5: 5 cycles were without an answer of the amplifiers. "
            "This is not a coil fault; check cable and load of the bus to the amplifiers. The next "
            "lift-off repeats the check",
        ),
        (
            blind_in_turn_8,
            "coil check skipped for coil 8: 82 cycles were without sensor readings. This is not a "
            "coil fault; check cable and load of the bus to the sensors. The next lift-off repeats "
            "the check",
        ),
    ],
)
def test_what_could_not_be_checked_and_why_is_one_plain_sentence(
    disturb: Callable[[np.ndarray, int, int], None], sentence: str
) -> None:
    pushes = Pushes.of(CoilCheck(), 9, 1000.0)
    rows = undisturbed_rows(pushes)
    disturb(rows, pushes.turn, pushes.push)
    found = coil_check(rows, pushes, load_rig(RIG_FILE).geometry)
    assert (found.error, found.skipped) == ("", sentence)
    assert bool(found.unjudged) == bool(sentence)


def test_check_whose_rows_were_overwritten_is_skipped() -> None:
    pushes = Pushes.of(CoilCheck(), 9, 1000.0)
    found = coil_check(undisturbed_rows(pushes)[:100], pushes, load_rig(RIG_FILE).geometry)
    assert found.skipped.startswith(
        "coil check skipped for all 9 coils: the rows of the check were overwritten"
    )
