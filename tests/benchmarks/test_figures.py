"""What benchmarks print: numbers that are what they are called, and none lost in silence."""

from __future__ import annotations

import json
from concurrent.futures import BrokenExecutor, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from levid.benchmarks.harness import code_version, isolated, silverbox
from levid.benchmarks.identification import greybox, identify, peers
from levid.benchmarks.trace import discrepancy, discrepancy_peers, trace_cost
from levid.identification.records.record import IdentificationError


def by_key(figures) -> dict[str, float]:
    return {figure.key: figure.value for figure in figures}


def test_coverage_of_other_code_does_not_count(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(greybox, "KEPT", tmp_path)

    def kept(error: float) -> None:
        """As a run that ended before would have left it."""
        name = f"coverage-8s-{greybox.version()}.jsonl"
        (tmp_path / name).write_text(json.dumps({"seed": 100, "z": [error]}) + "\n")

    monkeypatch.setattr(greybox, "code_version", lambda *_: "before")
    kept(0.5)
    assert by_key(greybox.coverage(1, 8.0))["coverage_percent"] == 100.0
    monkeypatch.setattr(greybox, "code_version", lambda *_: "after")
    kept(3.0)
    assert by_key(greybox.coverage(1, 8.0))["coverage_percent"] == 0.0


def test_fit_that_fails_is_a_miss_and_ends_no_run(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(greybox, "KEPT", tmp_path)
    monkeypatch.setattr(greybox, "ProcessPoolExecutor", lambda **_: ThreadPoolExecutor(1))

    def errors(seed: int, _: float) -> list[float]:
        if seed == 101:
            raise IdentificationError("expected a fit that converges")
        return [0.5, 3.0]

    monkeypatch.setattr(greybox, "errors_in_se", errors)
    for _ in range(2):  # flown, and as kept
        found = by_key(greybox.coverage(2, 8.0))
        assert (found["coverage_failed"], found["coverage_percent"]) == (1, 25.0)
        assert found["spread"] == pytest.approx(np.sqrt((0.5**2 + 3.0**2) / 2))

        def broken(*_: object) -> list[float]:
            raise BrokenExecutor

        monkeypatch.setattr(greybox, "errors_in_se", broken)
    with pytest.raises(BrokenExecutor):
        greybox.coverage(3, 8.0)


def test_version_is_that_of_the_code_that_is_needed(tmp_path: Path, monkeypatch) -> None:
    versions = code_version
    monkeypatch.setattr(versions, "ROOT", tmp_path)
    files = {
        "identification/fit.py": "from .data import read\nfrom ..model import effects\n",
        "identification/data.py": "def read():\n    from ..log.reader import x\n",
        "identification/other.py": "x = 1\n",
        "model/__init__.py": "",
        "model/effects.py": "import math\nfrom ..wire.crc import crc8\n",
        "log/reader.py": "x = 1\n",
        "wire/crc.py": "x = 1\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    changes = dict.fromkeys(files, False)
    for name in files:
        before = versions.code_version(["identification/fit.py"])
        with (tmp_path / name).open("a") as file:
            file.write("changed = 1\n")
        changes[name] = versions.code_version(["identification/fit.py"]) != before
    assert [name for name, changed in changes.items() if not changed] == [
        "identification/other.py", "wire/crc.py",
    ]  # fmt: skip


def test_version_is_of_what_runs_not_of_what_is_said_of_it() -> None:
    bare = code_version.bare
    said = '''"""What it is.

With a # of its own.
"""
x = "# no comment"  # a comment

Y = 1
"""What Y is."""


def f():
    """Return one."""
    return """kept"""
'''
    assert bare(said) == 'x = "# no comment"\nY = 1\ndef f():\n    return """kept"""'
    assert bare(said.replace("Return one", "Return 1")) == bare(said)
    assert bare(said.replace("Y = 1", "Y = 2")) != bare(said)


def test_versions_of_benchmarks_know_control_and_fit() -> None:
    flying = code_version.needed(code_version.FLYING)
    names = {"/".join(path.parts[-2:]) for path in flying}
    assert {
        "daemon/control/control_cycle.py",
        "sim/plant.py",
        "sim/plant_kernels.py",
        "log/writer.py",
    } <= names
    assert "daemon/api/control_server.py" not in names


def test_growth_of_a_trace_is_a_power_and_effects_are_those_flown(monkeypatch) -> None:
    trace = trace_cost
    monkeypatch.setattr(trace, "fly_session", lambda *_: [Path()] * 12)
    monkeypatch.setattr(trace, "silverbox", list)

    def apart(_call: object, logs: list[Path]) -> object:
        placed = (*trace.FLOWN[: len(logs) // 6], "air_damping.squeeze_film@psi")
        return isolated.Outcome(trace.Traced(3, placed, 8.0, 2.0, 2.0), len(logs) ** 1.5, 10**9)

    monkeypatch.setattr(trace, "_apart", apart)
    figures = trace.measure(False)
    found = by_key(figures)
    assert found["growth"] == pytest.approx(1.5)
    met = {figure.key: figure.met for figure in figures if figure.target}
    assert met == {"all_s": "met", "growth": "missed"}
    assert (found["quarter_s"], found["quarter_rounds"]) == (3**1.5, 3)
    assert (found["half_flown"], found["half_others"]) == (1, 1)
    assert (found["all_flown"], found["all_others"]) == (2, 1)
    assert (found["all_before"], found["all_after"]) == (4.0, 1.0)


def test_measured_data_that_are_not_there_are_told_and_no_cube_has_no_error(
    tmp_path: Path, monkeypatch
) -> None:
    trace = trace_cost
    monkeypatch.setattr(silverbox, "SOURCE", tmp_path / "none.csv")
    absent = trace.silverbox()
    assert {figure.value for figure in absent} == {None}
    assert {figure.met for figure in absent if figure.target} == {"not asked"}
    monkeypatch.setattr(silverbox, "SOURCE", tmp_path)
    found = trace.OnSilverbox(("stiffness.asymmetric",), 9e-3, None, 3e-4)
    monkeypatch.setattr(trace, "_apart", lambda _: isolated.Outcome(found, 7.0, 10**9))
    there = {figure.key: figure for figure in trace.silverbox()}
    assert [figure.key for figure in absent] == list(there)
    assert (there["silverbox_cubic_mv"].value, there["silverbox_cubic"].met) == (None, "missed")
    assert there["silverbox_traced_mv"].value == pytest.approx(0.3)
    assert there["silverbox_traced_mv"].met == "met"


def test_effects_of_the_trace_benchmark_are_in_the_table() -> None:
    from rig_effects import rig_places

    from levid.model.effects.table import all_effects

    assert set(trace_cost.FLOWN) <= {e.identity for e in all_effects(rig_places())}


@pytest.mark.parametrize("error", [np.inf, np.nan])
def test_a_response_that_is_no_number_is_told(error: float) -> None:
    contender = next(c for c in peers.CONTENDERS if c.key == "levid_subspace")
    bad = peers.Score(contender, 1.0, 2.0, error, 0.1, 100.0)
    found = peers.figures([bad])
    assert found["diverged_levid_subspace"] == 1.0
    assert "error_levid_subspace_percent" not in found
    good = peers.figures([peers.Score(contender, 1.0, 2.0, 3.0, 0.1, 100.0)])
    assert good["diverged_levid_subspace"] == 0.0
    failed = peers.figures([peers.Score(contender, failed="not done after 60 s")])
    assert failed == {"failed_levid_subspace": 1.0}
    rest = {figure.key: figure.value for figure in peers.told([bad]) if not figure.label}
    assert rest == found
    leads = [figure.value for figure in peers.told([bad]) if figure.label]
    assert leads == [None, None, None]  # there is no peer


def test_the_library_of_peers_has_products_drag_and_friction() -> None:
    peers = discrepancy_peers
    x = np.array([[2.0, 3e-3, -20.0]])
    library = peers.Library(np.array([1.0, 1e-3, 10.0]), (1, 2))
    assert library.powers.shape == (20, 3)  # (3 + 3 over 3)
    given = library.at(x)
    assert given.shape == (1, len(library))
    assert given[0, 0] == 1.0
    np.testing.assert_allclose(given[0, 20:], [9.0, -4.0, 1.0, -1.0])
    some = [3, 7, 21, 23]
    np.testing.assert_array_equal(library.at(x, some), given[:, some])
    coefficients = np.zeros((len(library), 1))
    coefficients[some, 0] = 1.0
    law = peers.ForceLaw(library, coefficients)
    assert law.terms == 4
    np.testing.assert_allclose(law.at(x), given[:, some].sum(axis=1, keepdims=True))


@pytest.mark.parametrize("who", ["PySINDy", "SysIdentPy"])
def test_peers_find_the_functions_that_a_force_is_made_of(who: str) -> None:
    pytest.importorskip(who.lower())
    peers = discrepancy_peers
    rng = np.random.default_rng(1)
    x = rng.standard_normal((4000, 3)) * (1.0, 1e-3, 20.0)
    library = peers.Library(x.std(axis=0), (2,))
    laws = (
        2e9 * x[:, 1] ** 3 - 0.3 * x[:, 0] * x[:, 2],
        0.2 * np.abs(x[:, 2]) * x[:, 2] + 5.0 * np.tanh(10.0 * x[:, 2] / library.scale[2]),
    )
    for law in laws:
        force = law[:, None]
        size, block = force.std(axis=0), np.arange(len(x)) // 100
        peers.load(who)
        found = peers.PEERS[who](peers.Sample((library.at(x),), force / size, library, size, block))
        # Taken one by one, v comes before the |v| v that it looks like, and keeps next to nothing.
        assert found.terms in (2, 3)
        np.testing.assert_allclose(found.at(x), force, atol=1e-6 * size[0])


def test_levid_is_judged_by_what_it_knows_and_beside_the_best_of_the_others() -> None:
    def rows(case: str, *errors: float) -> list[object]:
        names = ("declared", "levid", "PySINDy", "SysIdentPy")
        return [
            discrepancy.Row(case, who, error, 1.0, 0.1, 3.0, "", prepared=2.0)
            for who, error in zip(names, errors, strict=True)
        ]

    found = {f.key: f for f in discrepancy.told(rows("cubic-z", 20.0, 1.1, 2.2, np.inf))}
    assert found["error_over_floor_levid_cubic_z"].met == "met"
    assert found["levid_over_best_cubic_z"].value == pytest.approx(0.5)
    assert found["prepared_pysindy_cubic_z_s"].value == 2.0
    found = {f.key: f for f in discrepancy.told(rows("eddy-brake", 20.0, 3.0, np.nan, np.inf))}
    assert found["error_over_floor_levid_eddy_brake"].met is None
    assert found["levid_over_best_eddy_brake"].value is None
    assert len(discrepancy.table(rows("cubic-z", 20.0, 1.1, 2.2, 3.3)).rows) == 4


@pytest.mark.parametrize("error", [np.inf, np.nan])
def test_a_model_that_runs_away_is_told(error: float) -> None:
    found = discrepancy.figures([discrepancy.Row("cubic-z", "levid", error, 1.2, 0.1, 3.0, "")])
    assert found["diverged_levid_cubic_z"] == 1.0
    assert found["failed_levid_cubic_z"] == 0.0
    assert "error_levid_cubic_z" not in found
    absent = discrepancy.Row("cubic-z", "PySINDy", *[np.nan] * 4, "not installed", failed=True)
    assert discrepancy.figures([absent]) == {"failed_pysindy_cubic_z": 1.0}


def test_couplings_that_nobody_can_judge_have_no_error(monkeypatch) -> None:
    freq_hz = np.array([2.0, 20.0])
    true = np.ones((2, 3, 3), complex) + 9.0 * np.eye(3)
    monkeypatch.setattr(identify, "frequency_response", lambda *_: true)

    def errors(P: np.ndarray, noise: float) -> dict[str, float]:
        quiet = np.full(P.shape, noise)
        return by_key(
            identify.errors(
                [identify.Estimate(key, 0.0, freq_hz, P, quiet) for key in identify.LABELS]
            )
        )

    found = errors(10.0 ** (1 / 20) * true, 1.0)
    assert found["subspace_db"] == pytest.approx(1.0)
    assert found["subspace_offdiag_percent"] == 0.0
    assert "subspace_offdiag_db" not in found
    found = errors(10.0 ** (1 / 20) * true, 0.01)
    assert found["subspace_offdiag_percent"] == 100.0
    assert found["subspace_offdiag_db"] == pytest.approx(1.0)
    # No number is no small error.
    assert np.isnan(errors(np.nan * true, 0.01)["subspace_db"])
