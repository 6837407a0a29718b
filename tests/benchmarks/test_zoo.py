"""The zoo's rules: what counts as right, how large effects are, what is compared with truth."""

from __future__ import annotations

import json
import math
import signal
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from levid.benchmarks.trace import unlisted_effects, zoo
from levid.benchmarks.trace import zoo_cases as cases
from levid.benchmarks.trace import zoo_plan as plan
from levid.benchmarks.trace import zoo_results as results
from levid.benchmarks.trace import zoo_score as scoring
from levid.benchmarks.trace import zoo_sizes as sizes
from levid.benchmarks.trace import zoo_tables as tables
from levid.benchmarks.trace import zoo_truth as truth
from levid.config.base import load_yaml
from levid.config.model import ModelConfig
from levid.config.rig import RigConfig
from levid.config.shipped import shipped
from levid.model.effects.base import Places
from levid.model.effects.driven_range import Extent
from levid.model.effects.table import all_effects
from levid.model.geometry import shape_matrix

CASE = {case.name: case for case in cases.CASES + cases.UNLISTED}


def said(*effects, before=6.0, after=1.2, floor=1.2, significant=False):
    """Return what `levid trace --json` prints for (class, where, alternatives, signals)."""
    found = []
    for kind, where, *rest in effects:
        others = [{"class": k, "where": w.split()} for k, w in (rest[0] if rest else [])]
        evidence = {"alternatives": others, "signals": rest[1] if len(rest) > 1 else []}
        found.append({"class": kind, "where": where.split(), "evidence": evidence})
    validation = {"before": before, "after": after, "noise_floor": floor}
    return {
        "effects": found,
        "validation": validation,
        "unexplained": {"significant": significant},
    }


def score(names, *effects, **errors):
    return scoring.score_plant([CASE[name] for name in names.split()], said(*effects, **errors))


def test_class_and_place_make_it_right() -> None:
    right = score("cubic-z", ("rod_stiffness", "z"))
    assert (right.right, right.family, right.missed, right.false_alarms) == (True, True, 0, 0)
    assert right.before_over_floor == pytest.approx(5.0)
    assert right.after_over_floor == pytest.approx(1.0)


def test_two_forms_of_one_effect_are_one() -> None:
    assert score("cubic-z", ("rod_stiffness", "z"), ("rod_stiffness", "z")).right


@pytest.mark.parametrize(
    ("effects", "family", "missed", "alarms"),
    [
        ([], False, 1, 0),
        ([("rod_stiffness", "psi")], False, 1, 1),
        ([("rod_stiffness", "psi theta z")], True, 0, 0),  # a third of the places is true
        ([("rod_stiffness", "z"), ("rod_stiffness", "psi")], True, 0, 1),
        ([("rod_stiffness", "z"), ("coil_gain", "coil:3")], True, 0, 1),
        ([("air_damping", "z")], False, 1, 1),
    ],
)
def test_what_is_not_right(effects, family, missed, alarms) -> None:
    found = score("cubic-z", *effects)
    assert not found.right
    assert (found.family, found.missed, found.false_alarms) == (family, missed, alarms)


def test_neighbour_in_the_family_is_no_more_than_that() -> None:
    found = score("coulomb-z", ("air_damping", "z"))
    assert (found.right, found.family, found.missed, found.false_alarms) == (False, True, 0, 1)


def test_set_that_holds_the_truth_is_right_unless_it_holds_everything() -> None:
    lag = score("lag-coil-5", ("delay", "coil:5", [("actuator_lag", "coil:5")]))
    assert lag.right
    assert lag.in_a_set
    beside = score("lag-coil-5", ("actuator_lag", "coil:5"), ("delay", "coil:5"))
    assert (beside.right, beside.false_alarms) == (False, 1)
    alone = score("lag-coil-5", ("delay", "coil:5"))  # says more than the data do
    assert (alone.right, alone.family, alone.false_alarms) == (False, True, 0)
    others = [("coil_gain", "coil:5"), ("friction", "z"), ("actuator_lag", "coil:5")]
    assert not score("lag-coil-5", ("delay", "coil:5", others)).right


def test_beam_and_rotor_are_implied_by_a_class() -> None:
    assert score("beam-gravity", ("beam_motion", "theta")).right
    assert score("imbalance", ("rotor", "rotor psi"), ("rotor", "rotor theta")).right
    assert not score("imbalance", ("rotor", "rotor psi")).right
    assert score("presliding-along", ("friction", "theta")).right
    assert score("motor-friction", ("friction", "beam")).right
    assert not score("beam-gravity", ("beam_motion", "psi")).right


@pytest.mark.parametrize(
    ("name", "effects", "alarms"),
    [
        ("motor-friction", [("friction", "beam theta")], 0),  # half of what it says
        ("beam-coriolis", [("beam_motion", "theta")], 0),  # half of what there is
        ("presliding-along", [("friction", "beam psi")], 1),
        ("presliding-along", [("friction", "beam")], 1),  # that of the motors
        ("presliding-along", [("friction", "theta"), ("friction", "beam psi")], 1),
        ("presliding-across", [("friction", "psi"), ("friction", "beam theta")], 1),
        ("imbalance", [("rotor", "rotor psi"), ("rotor", "rotor theta"), ("rotor", "rotor z")], 1),
    ],
)
def test_beam_and_rotor_make_no_wrong_place_right(name, effects, alarms) -> None:
    found = score(name, *effects)
    assert not found.right
    assert found.false_alarms == alarms


def test_absorbed_effect_may_be_unseen_but_not_called_another() -> None:
    unseen = score("delay-all", before=1.25)
    assert (unseen.right, unseen.hidden) == (True, True)
    assert not score("delay-all", ("coil_gain", "coil:1"), before=1.25).right
    assert not score("delay-all").right  # an error of five floors is not absorbed
    named = score("delay-all", ("delay", " ".join(f"coil:{i}" for i in range(9))), before=1.25)
    assert (named.right, named.hidden) == (True, False)


def test_what_the_drives_alone_feel_is_to_be_found_there() -> None:
    assert score("cogging", ("cogging", "beam"), before=1.2).right
    assert not score("cogging", before=1.2).right


def test_one_report_is_not_two_effects() -> None:
    either = ("rod_stiffness", "z", [("coil_gain", "coil:3")])
    assert not score("cubic-z gain-coil-3", either).right
    assert score("cubic-z gain-coil-3", either, ("coil_gain", "coil:3")).right
    assert score("cubic-z gain-coil-3", ("coil_gain", "coil:3"), either).right
    assert not score("cubic-z gain-coil-3 coulomb-z", either, ("friction", "z")).right


def test_errors_are_over_the_floor_of_a_plant_that_holds_nothing() -> None:
    """A sensor that sticks is noise to a trace: its own floor would hide what is there."""
    summary = said(("sensor_stuck", "sensor:8"), before=9.0, after=2.4, floor=8.0)
    of = [CASE["sticking-sensor-8"]]
    own, over = (scoring.score_plant(of, summary, (), floor) for floor in (None, 1.2))
    assert (own.before_over_floor, own.own_floor) == (9.0 / 8.0, 1.0)
    assert over.before_over_floor == pytest.approx(7.5)
    assert over.after_over_floor == pytest.approx(2.0)
    assert over.own_floor == pytest.approx(8.0 / 1.2)
    unseen = said(before=9.0, after=9.0, floor=8.0)
    assert scoring.score_plant([CASE["delay-all"]], unseen, ()).hidden
    assert not scoring.score_plant([CASE["delay-all"]], unseen, (), 1.2).hidden
    described = said(("unknown", "sensor:0", [], ["coil:3"]), before=9.0, after=8.0, floor=8.0)
    assert scoring.score_plant([CASE["stray-field"]], described, ()).halved
    assert not scoring.score_plant([CASE["stray-field"]], described, (), 1.2).halved
    found = {"summary": summary, "sensor_sd_m": 1e-7}
    plant = plan.Plant("alone", tuple(of), 5.0, 1)
    assert results.Result(plant, found, floor_m=1.2e-7).floor == pytest.approx(1.2)
    assert results.Result(plant, found).floor is None
    assert results.Result(plant, {"summary": summary}, floor_m=1.2e-7).floor is None


def test_pair_needs_both() -> None:
    both = ("rod_stiffness", "z"), ("coil_gain", "coil:3")
    assert score("cubic-z gain-coil-3", *both).right
    half = score("cubic-z gain-coil-3", both[0])
    assert (half.right, half.family, half.missed) == (False, False, 1)


def test_nothing_is_right_where_nothing_is() -> None:
    assert score("").right
    assert not score("", significant=True).right
    assert score("", ("coil_gain", "coil:1")).false_alarms == 1


def test_unlisted_effect_is_to_be_described_not_named() -> None:
    described = ("unknown", "theta z", [], ["theta'", "x_b"])
    turning = ("unknown", "psi theta", [], ["phi'", "psi'"])
    assert score("gyroscope", turning).described
    assert not score("gyroscope", ("unknown", "psi theta", [], ["psi'"])).described  # of the rotor?
    assert not score("gyroscope", ("unknown", "psi", [], ["psi'", "phi'", "z", "x_b"])).described
    assert score("hung-plug", ("unknown", "psi z", [], ["z"])).described
    assert score("eddy-brake", described).right
    assert not score("eddy-brake", described, after=4.0).right
    assert not score("eddy-brake", ("unknown", "theta z", [], ["z'", "x_b"])).described
    assert not score("eddy-brake", ("unknown", "theta", [], ["theta'", "x_b"])).described
    assert not score("eddy-brake", ("unknown", "theta z", [], ["x_b", "phi", "psi"])).right
    assert score("shared-yoke", ("unknown", "coil:5", [], ["coil:4"])).described
    assert not score("shared-yoke", ("unknown", "coil:5", [], ["coil:5"])).described
    assert not score("shared-yoke", ("unknown", "coil:4", [], ["coil:4"])).described
    assert score("closed-cover", ("unknown", "theta", [], ["v_b"])).described
    assert not score("closed-cover", ("unknown", "psi", [], ["v_b"])).described
    assert score("pulled-oscillator", ("unknown", "sensor:7", [], ["psi"])).described
    assert not score("pulled-oscillator", ("unknown", "sensor:7", [], ["theta"])).described
    assert not score("pulled-oscillator", ("sensor_crosstalk", "sensor:7")).right  # no signals
    assert score("pulled-oscillator", ("sensor_crosstalk", "sensor:7 sensor:8")).right
    assert not score("pulled-oscillator", ("sensor_crosstalk", "sensor:7 sensor:2")).described
    for elsewhere in ("sensor:0 sensor:1", "sensor:8 sensor:7"):
        assert score("pulled-oscillator", ("sensor_crosstalk", elsewhere)).misnamed
    assert score("second-stage", ("unknown", "coil:3", [], ["coil:3"])).described
    assert score("second-stage", ("coil_gain", "coil:3")).misnamed
    assert score("stray-field", ("sensor_offset", "sensor:0")).misnamed
    assert score("eddy-brake", ("air_damping", "z")).misnamed
    assert score("eddy-brake", ("air_damping", "z", [("friction", "z")]), described).misnamed
    assert not score("eddy-brake", ("air_damping", "z", [("unknown", "z")])).misnamed


def test_every_unlisted_effect_has_its_signals() -> None:
    assert set(scoring.SIGNALS) == {case.name for case in cases.UNLISTED}


def test_result_without_numbers_is_scored() -> None:
    """A model that runs away has no error after; that is a null in JSON."""
    assert not score("cubic-z", ("rod_stiffness", "z"), after=None).right
    assert math.isnan(score("cubic-z", ("rod_stiffness", "z"), after=None).after_over_floor)


class Flown:
    """Flights whose effect adds (gain scale)^power to the floor, in squares, up to `largest`."""

    def __init__(self, gain: float, power: float, largest: float = math.inf) -> None:
        self.gain, self.power, self.largest, self.scales = gain, power, largest, []

    def __call__(self, effects, seed):
        (entry,) = effects
        scale = entry["k3_n_m3"] / CASE["cubic-z"].values["k3_n_m3"]
        self.scales.append(scale)
        if scale > self.largest:
            raise sizes.TooLargeError("it meets its stops")
        return math.sqrt(1 + (self.gain * scale) ** (2 * self.power))


@pytest.mark.parametrize(("gain", "power"), [(4.0, 1.0), (4.0, 0.7), (40.0, 1.3), (0.5, 1.0)])
def test_size_is_found_in_few_flights(gain, power) -> None:
    """A power law is interpolated exactly between two flights, to the four digits that are kept."""
    flown = Flown(gain, power)
    found = sizes._Search(CASE["cubic-z"], flown).run()
    assert len(flown.scales) <= 4
    for times in (5.0, 20.0):
        true = (times**2 - 1) ** (0.5 / power) / gain
        assert found.scale(times) == pytest.approx(true, rel=2e-3)
    assert found.scale(1.5) == pytest.approx((1.5**2 - 1) ** (0.5 / power) / gain, rel=2e-3)
    assert found.limited == ""


def test_size_ends_where_the_plant_does() -> None:
    flown = Flown(4.0, 1.0, largest=3.0)
    found = sizes._Search(CASE["cubic-z"], flown).run()
    assert found.scale(5.0) == pytest.approx(math.sqrt(24) / 4, rel=1e-3)
    assert found.scale(20.0) == pytest.approx(max(s for s in flown.scales if s <= 3.0), rel=1e-3)
    assert found.scale(20.0) == pytest.approx(3.0, rel=0.1)
    assert found.limited == "it meets its stops"


def test_size_is_flown_where_a_power_law_is_not_what_it_grows_with() -> None:
    """A sensor that sticks leaves little, and then all at once: no line leads from one to other."""
    flown = Flown(4.0, 1.0)

    def steep(effects, seed):
        ratio = flown(effects, seed)
        return ratio if ratio < 5.6 else 5.6 * (ratio / 5.6) ** 5

    found = sizes._Search(CASE["cubic-z"], steep).run()
    entry = CASE["cubic-z"].effect(found.scale(20.0))
    assert steep([entry], 1) == pytest.approx(20.0, rel=0.25)


def test_size_keeps_to_what_makes_sense() -> None:
    """Minus all of Coriolis' force is the most that can be missing."""
    assert sizes._largest(CASE["beam-coriolis"]) == (1.0, "excess 1 at most")
    bent = CASE["bent-sensor-0"]
    assert sizes._largest(bent)[0] == pytest.approx(bent.values["distance_m"] / 2e-3)


def test_case_that_cannot_be_sized_is_flown_as_it_is(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(sizes, "SIZES", tmp_path / "sizes.yaml")
    case = CASE["cubic-z"]
    failed = SimpleNamespace(item=case, answer=None, failed="it meets its stops")
    monkeypatch.setattr(sizes, "run_apart", lambda *_: [failed])
    monkeypatch.setattr(sizes, "noise_floor_m", lambda _: 1e-7)
    said_of: list[str] = []
    found = sizes.sizes_of([case], 1, said_of.append)
    assert found["cubic-z"].scale(5.0) == found["cubic-z"].scale(1.5) == 1.0
    assert "it meets its stops" in said_of[-1]
    assert not sizes.SIZES.exists()


def test_sizes_survive_their_file(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(sizes, "SIZES", tmp_path / "sizes.yaml")
    known = {"a": sizes.Sizes("0a", {5.0: 1.5, 20.0: 6.5}, ((1.0, 3.3), (6.3, 19.0)), "stops")}
    sizes._write(known)
    assert sizes._read() == known
    clean = SimpleNamespace(item=1, answer=1.3e-7, failed="")
    monkeypatch.setattr(sizes, "run_apart", lambda *_: [clean])
    assert sizes.noise_floor_m(lambda _: None) == 1.3e-7
    monkeypatch.setattr(sizes, "run_apart", lambda *_: [])
    sizes._write(known)
    assert sizes.noise_floor_m(lambda _: None) == 1.3e-7
    assert sizes._read() == known


def rig_places() -> Places:
    rig = load_yaml(shipped("rigs/loopback.yaml"), RigConfig).geometry
    model = load_yaml(shipped("models/rig.yaml"), ModelConfig)
    xy_m = np.stack([rig.coil_x_m, rig.coil_y_m], axis=1)
    shape = shape_matrix(rig.coil_x_m, rig.coil_y_m)
    return Places(
        tuple(q.name for q in model.dof),
        tuple(q.unit for q in model.dof),
        shape,
        shape,
        "N",
        tuple(q.unit for q in model.inputs),
        "m",
        xy_m,
        xy_m,
        beam=True,
    )


def test_every_known_number_can_be_read_from_a_candidate() -> None:
    """Keys, places and parameters of the truth are those of the table of candidates."""
    places = rig_places()
    tones = (17.3, 50.0, 100.0, 150.0)
    extent = Extent(**{**vars(Extent.typical(places)), "tones_hz": tones})
    table = all_effects(places, extent)
    missing = set()
    for case in cases.CASES:
        entry = case.effect(1.0)
        for known in truth._KNOWN.get(entry["use"].rpartition(":")[2], truth._nothing)(entry):
            fit = [
                {q.name: 1.0 for q in (*e.amplitudes, *e.shape)} | _shape(e)
                for e in table
                if cases.is_called(e.key, known.key)
                and (known.where is None or set(e.where) == known.where)
            ]
            # Some have no candidate of all coils alike: then nothing compares.
            alike = known.where is not None and len(known.where) == 9
            if not alike and not any(known.of(values) is not None for values in fit):
                missing.add(case.name)
    # What the floor shakes at random is in no table: it is no part of a model.
    assert missing == {"floor-noise"}


def _shape(effect) -> dict[str, float]:
    return dict(zip((q.name for q in effect.shape), effect.grid[0], strict=True))


def test_parameters_compare_in_the_units_of_the_candidates() -> None:
    entry = CASE["cubic-psi"].effect(1.0)
    k3 = entry["k3_n_m3"] * 0.12**4
    placed = [
        {
            "effect": "rod_stiffness.cubic",
            "where": ["psi"],
            "parameters": {"k3": {"value": 1.1 * k3}},
        }
    ]
    (number,) = truth.compared([entry], placed)
    assert number.error == pytest.approx(0.1)
    assert truth.compared([entry], [{**placed[0], "where": ["z"]}]) == []


def test_moment_of_a_payload_is_judged_by_the_length_of_a_record() -> None:
    """5 % of the session's clock would be 7 s."""
    entry = CASE["payload"].effect(1.0)
    values = {"m": entry["mass_kg"], "x": entry["x_m"], "y": entry["y_m"]}
    values["time"] = entry["begin_s"] + 1.2
    placed = [
        {
            "effect": "payload",
            "where": ["psi", "theta", "z"],
            "parameters": {name: {"value": value} for name, value in values.items()},
        }
    ]
    (when,) = (n for n in truth.compared([entry], placed) if n.label == "time")
    assert when.error == pytest.approx(1.2 / 24.0)


def test_force_of_a_trembling_floor_is_told_without_a_tone() -> None:
    case = CASE["floor-noise"]
    entry = case.effect(1.0)
    parameters = {"rms": {"value": 1.04 * entry["rms_m_s2"] * entry["mass_kg"]}, "low": {}}
    summary = said(("vibration", "z"))
    tone = [{"effect": "vibration.force.17hz", "where": ["z"], "parameters": {}}]
    assert not scoring.score_plant([case], summary, tone).mechanism
    summary["effects"][0]["parameters"] = {"rms": {"value": 0.0}}
    assert scoring.score_plant([case], summary, ()).mechanism
    summary["effects"][0]["parameters"] = parameters | {"low": {"value": 8.0}}
    (rms,) = truth.compared([entry], scoring.named(summary, ()))
    assert rms.error == pytest.approx(0.04)


def test_plans_are_as_large_as_they_say() -> None:
    quick, usual, full = plan.plan(True, False), plan.plan(False, False), plan.plan(False, True)
    assert len(quick) == 8
    assert len({(p.name, p.seed) for p in full}) == len(full)
    every = len(cases.CASES) + len(cases.UNLISTED)
    as_it_is = sum(case.absorbed is not None or not case.sized for case in cases.CASES)
    unseen = [case for case in cases.UNLISTED if case.unseen]
    assert len(unseen) >= 3
    assert len(usual) == 2 * (len(cases.CASES) + len(unseen)) + 20
    assert {p.name for p in usual if not p.name.startswith("nothing")} <= {p.name for p in full}
    assert len(plan.plan(False, False, every=True)) == 2 * every + 20
    assert len(full) == 3 * (3 * every - as_it_is) + 50
    for p in full:
        if p.kind in ("pair", "triple"):
            assert len(p.cases) == {"pair": 2, "triple": 3}[p.kind]
            assert all(case.absorbed is None and case.sized for case in p.cases)
            places = [(case.kind, place) for case in p.cases for place in case.where]
            assert len(set(places)) == len(places)
    others = plan.plan(False, False, 9000)
    assert not {p.seed for p in others} & {p.seed for p in usual}
    pairs = [
        {" + ".join(c.name for c in p.cases) for p in some if p.kind == "pair"}
        for some in (usual, others)
    ]
    assert pairs[0] != pairs[1]


def test_every_mechanism_is_in_the_table_of_effects() -> None:
    table = all_effects(rig_places())
    for case in cases.CASES:
        for key in case.keys:
            kinds = {e.effect_class for e in table if cases.is_called(e.key, key)}
            known = case.absorbed is not None or key == "vibration.random"  # in no table
            assert case.kind in kinds or known, (case.name, key, kinds)


def test_a_mechanism_is_more_than_its_class() -> None:
    summary = said(("friction", "theta"))
    along = [CASE["presliding-along"]]

    def placed(effect: str) -> list[dict[str, object]]:
        return [{"effect": effect, "where": ["theta"]}]

    assert scoring.score_plant(along, summary, placed("friction.bearing")).mechanism
    chain = scoring.score_plant(along, summary, placed("friction.coulomb"))
    assert (chain.right, chain.mechanism) == (True, False)
    assert cases.is_called("friction.beam", "friction.beam")
    assert cases.is_called("vibration.force.50hz", "vibration.force")
    assert not cases.is_called("friction.beam_tilt", "friction.beam")
    dahl, lugre = (
        scoring.score_plant(
            [CASE[name]],
            said(("friction", where)),
            [{"effect": "friction.bouc_wen", "where": [where]}],
        )
        for name, where in (("dahl-theta", "theta"), ("lugre-z", "z"))
    )
    assert (dahl.mechanism, lugre.mechanism) == (True, False)
    twice = scoring.score_plant(along, said(("friction", "theta"), ("friction", "theta")), ())
    assert (twice.right, twice.extra) == (True, 1)


def test_results_are_kept_and_a_line_cut_off_is_no_result(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(results, "code_version", lambda: "a")
    some = {"cubic-z": sizes.Sizes("0a", {5.0: 1.0, 20.0: 4.0})}
    plants = [plan.Plant("alone", (CASE["cubic-z"],), t, 1) for t in (5.0, 20.0)]
    kept = results.Kept(tmp_path)
    found = {"summary": said(("rod_stiffness", "z")), "placed": [], "flight_s": 1.0, "trace_s": 2.0}
    kept.add(results.Result(plants[0], found), some)
    with (tmp_path / "results.jsonl").open("a") as file:
        file.write('{"key": "cut o')
    again = results.Kept(tmp_path)
    assert [again.has(p, some) for p in plants] == [True, False]
    numbers = tables.figures(again.of(plants, some))
    assert (numbers["plants"], numbers["right"], numbers["failed"]) == (2, 1, 1)
    assert numbers["alone_5x_right_percent"] == 100
    monkeypatch.setattr(results, "code_version", lambda: "b")
    assert not results.Kept(tmp_path).has(plants[0], some)


def test_published_results_are_those_of_this_code_and_need_not_be_flown(
    tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(results, "code_version", lambda: "a")
    some = {"cubic-z": sizes.Sizes("0a", {5.0: 1.0, 20.0: 4.0})}
    plants = [plan.Plant("alone", (CASE["cubic-z"],), t, 1) for t in (5.0, 20.0)]
    found = {"summary": said(("rod_stiffness", "z")), "placed": [], "flight_s": 1.0, "trace_s": 2.0}
    kept, file = results.Kept(tmp_path / "mine"), tmp_path / "results.jsonl.gz"
    kept.add(results.Result(plants[0], found), some)
    kept.add(results.Result(plants[1], None, "stopped"), some)
    assert kept.publish(file) == 1
    theirs = results.Kept(tmp_path / "empty", file)
    assert [theirs.has(p, some) for p in plants] == [True, False]
    written = file.read_bytes()
    theirs.publish(file)
    assert file.read_bytes() == written
    afresh = results.Kept(tmp_path / "afresh")  # knows nothing of what was published
    afresh.add(results.Result(plants[1], found), some)
    assert afresh.publish(file) == 2
    assert all(results.Kept(tmp_path / "empty", file).has(p, some) for p in plants)
    monkeypatch.setattr(results, "code_version", lambda: "b")
    assert not results.Kept(tmp_path / "empty", file).has(plants[0], some)


def test_a_result_is_kept_for_what_an_effect_of_a_file_is_not_for_where_it_lies(
    tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(results, "code_version", lambda: "a")
    some = {"gyroscope": sizes.Sizes("0a", {5.0: 1.0, 20.0: 4.0})}
    found = {"summary": said(), "placed": [], "flight_s": 1.0, "trace_s": 2.0}

    def plant(file: Path, text: str) -> plan.Plant:
        file.write_text(text)
        case = replace(CASE["gyroscope"], use=f"{file}:Gyroscope")
        return plan.Plant("unlisted", (case,), 5.0, 1)

    kept = results.Kept(tmp_path)
    kept.add(results.Result(plant(tmp_path / "here.py", "1"), found), some)
    assert kept.has(plant(tmp_path / "there.py", "1"), some)
    assert not kept.has(plant(tmp_path / "here.py", "2"), some)


def test_plant_that_meets_its_stops_is_flown_with_less_and_kept_as_it_was_flown(
    tmp_path, monkeypatch
) -> None:
    cube = {"cubic-z": sizes.Sizes("0a", {5.0: 2.0, 20.0: 8.0})}
    asked = plan.Plant("alone", (CASE["cubic-z"],), 5.0, 1)
    (full,) = asked.entries(cube)
    flown = []

    def fly_and_trace(entries, seed, flights):
        flown.append(entries[0]["k3_n_m3"] / full["k3_n_m3"])
        if flown[-1] > 0.7:
            raise zoo.TooLargeError("a corner moves 0.9 mm")
        return zoo.Found(said(("rod_stiffness", "z")), [], 1e-7, 0.8e-3, 1.0, 2.0)

    def in_this_process(run, items, *_):
        for item in items:
            yield SimpleNamespace(item=item, answer=run(item), failed="", seconds=3.0)

    monkeypatch.setattr(zoo, "fly_and_trace", fly_and_trace)
    monkeypatch.setattr(zoo, "flies_empty", lambda seed: seed in allowed)
    monkeypatch.setattr(zoo, "run_apart", in_this_process)
    allowed = {1}
    zoo._fly_all([asked], cube, results.Kept(tmp_path), 1e-7, None)
    assert flown == pytest.approx([1.0, 0.8, 0.64])
    (result,) = results.Kept(tmp_path).of([asked], cube)
    assert result.entries[0]["k3_n_m3"] == pytest.approx(0.64 * full["k3_n_m3"])
    assert (result.less, result.wall_s, result.seconds) == (True, 3.0, 3.0)
    assert result.seed == 1
    allowed = {1001}
    zoo._fly_all([asked], cube, results.Kept(tmp_path / "drawn"), 1e-7, None)
    assert results.Kept(tmp_path / "drawn").of([asked], cube)[0].seed == 1001
    lines = (tmp_path / "results.jsonl").read_text()
    (tmp_path / "results.jsonl").write_text(lines.replace('"less": true, ', ""))
    assert results.Kept(tmp_path).of([asked], cube)[0].less  # its values tell


def flown_before(tmp_path, monkeypatch, count: int = 2):
    """Return plants of the cube with their sizes, `count` of them with a result in a folder."""
    monkeypatch.setattr(results, "code_version", lambda: "a")
    some = {"cubic-z": sizes.Sizes("0a", {5.0: 1.0, 20.0: 4.0})}
    plants = [plan.Plant("alone", (CASE["cubic-z"],), t, 1) for t in (5.0, 20.0)]
    k3 = {"value": 1.04 * CASE["cubic-z"].values["k3_n_m3"]}
    cube = [{"effect": "rod_stiffness.cubic", "where": ["z"], "parameters": {"k3": k3}}]
    found = {"summary": said(("rod_stiffness", "z")), "placed": cube}
    found |= {"flight_s": 600.0, "trace_s": 3000.0, "sensor_sd_m": 1e-7}
    kept = results.Kept(tmp_path)
    for plant in plants[:count]:
        kept.add(results.Result(plant, found, "", tuple(plant.entries(some))), some)
    return plants, some


def test_targets_stand_beside_figures(tmp_path, monkeypatch) -> None:
    plants, some = flown_before(tmp_path, monkeypatch)
    found = results.Kept(tmp_path).of(plants, some, 1.2e-7)
    by_key = {figure.key: figure for figure in tables.told(found, 2)}
    assert by_key["alone_5x_and_20x_right_percent"].met == "met"
    assert by_key["pair_5x_right_percent"].met == "not asked"
    assert by_key["alone_20x_within_5_percent"].met == "missed"  # four times as large as flown
    assert (by_key["hours"].value, by_key["hours"].met) == (1.0, "met")
    assert {f.key: f.met for f in tables.told(found[:1], 2)}["hours"] == "undecided"
    assert {f.key: f.met for f in tables.told(found, None)}["hours"] is None
    numbers = {key: figure.value for key, figure in by_key.items()}
    assert numbers["alone_5x_within_5_percent"] == 100.0
    assert (numbers["mechanism_percent"], numbers["not_compared"]) == (100.0, 0.0)
    assert (numbers["own_floor"], numbers["flown_with_less"]) == (1.0, 0.0)
    assert "unlisted_misnamed" in numbers
    assert "own_floor" not in tables.figures(results.Kept(tmp_path).of(plants, some))
    other = [{"effect": "rod_stiffness.corners", "where": ["z"], "parameters": {}}]
    found[0].found["placed"] = other
    numbers = tables.figures(found)
    assert (numbers["mechanism_percent"], numbers["not_compared"]) == (50.0, 1.0)


def test_what_is_kept_is_shown_without_flying(tmp_path, monkeypatch, capsys) -> None:
    plants, some = flown_before(tmp_path, monkeypatch)
    shown = results.Kept(tmp_path).all("a", some)
    assert [result.plant for result in shown] == plants
    assert not any(result.less for result in shown)
    monkeypatch.setattr(zoo, "PUBLISHED", tmp_path / "published.gz")
    options = ["zoo", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", [*options, "--show", "--json", "--times", "20", "--publish"])
    zoo.main()
    said_of = json.loads(capsys.readouterr().out)
    assert said_of["figures"]["plants"] == 1
    assert said_of["met"]["nothing_false_alarms"] is None
    assert len(results.Kept(tmp_path / "empty", zoo.PUBLISHED).all("a", some)) == 2
    monkeypatch.setattr(sys, "argv", [*options, "--show", "b"])
    with pytest.raises(SystemExit, match="there are: 2 of a"):
        zoo.main()
    monkeypatch.setattr(sys, "argv", [*options, "--times", "1.5"])
    with pytest.raises(SystemExit, match="add --full"):
        zoo.main()


@pytest.mark.parametrize("stop", [KeyboardInterrupt(), SystemExit(143)])
def test_what_there_is_at_an_interrupt_is_printed(tmp_path, monkeypatch, capsys, stop) -> None:
    plants, some = flown_before(tmp_path, monkeypatch, count=1)
    ended = []

    def interrupted(*_):
        try:
            raise stop
            yield
        finally:
            ended.append(True)

    for name, value in {
        "run_apart": interrupted, "plan": lambda *_: plants, "sizes_of": lambda *_: some,
        "noise_floor_m": lambda _: 1e-7, "PUBLISHED": tmp_path / "none.gz",
    }.items():  # fmt: skip
        monkeypatch.setattr(zoo, name, value)
    monkeypatch.setattr(signal, "signal", lambda *_: None)  # pytest's own stay
    monkeypatch.setattr(sys, "argv", ["zoo", "--out", str(tmp_path), "--json", "--publish"])
    with pytest.raises(type(stop)):
        zoo.main()
    assert zoo.PUBLISHED.exists()
    said_of = json.loads(capsys.readouterr().out)
    assert said_of["figures"]["plants"] == 1
    assert type(stop).__name__ in said_of["incomplete"]
    assert ended


def test_no_plant_counts_twice() -> None:
    """Where nothing allows a larger effect it is flown twice all the same, with another seed."""
    as_it_is = sizes.Sizes("", {5.0: 1.0, 20.0: 1.0})
    known = dict.fromkeys(CASE, as_it_is) | sizes.known_sizes()
    for some in (plan.plan(False, True), plan.plan(False, False), plan.plan(True, False)):
        flown = {json.dumps([p.entries(known), p.seed]) for p in some}
        assert len(flown) == len(some)
        assert [plan.plant_named(p.name) for p in some] == some


def test_passing_beam_shows_on_its_sensor_alone() -> None:
    unlisted = unlisted_effects
    beam = unlisted.PassingBeam(4, 3e-6, at_m=0.03, width_m=0.02)
    beam.reset(None)
    assert beam.wrench(0.0, np.zeros(3), np.zeros(3), SimpleNamespace(x_m=0.05)) == (0.0, 0.0, 0.0)
    seen = beam.gap(0.0, np.zeros(9))
    assert seen[4] == pytest.approx(3e-6 * math.exp(-1))
    assert np.count_nonzero(seen) == 1


def test_torque_of_a_force_that_is_named_with_its_arm_need_not_be_named_as_well() -> None:
    assert score("magnet-field", ("external_field", "z")).right
    assert score("magnet-field", ("external_field", "z"), ("external_field", "theta")).right
    assert not score("magnet-field", ("external_field", "theta")).right
    assert not score("magnet-field", ("external_field", "psi z")).right
