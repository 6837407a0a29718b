"""Test the export to other tools: they get the same model and the same response."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal
from scipy.io import loadmat

from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.identification.export import (
    control_frd,
    control_state_space,
    scipy_state_space,
    write_fitted_mat,
    write_mat,
    write_multisine_mat,
)
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.greybox.identify_greybox import GreyBox, identify_grey_box
from levid.identification.identify import identify
from levid.identification.nonparametric.frequency_response import ResponseEstimate
from levid.identification.nonparametric.nonlinear_distortion import DetectionLines
from levid.identification.nonparametric.robust_multisine import BestLinearApproximation
from levid.identification.options import Options
from levid.identification.records.signal_names import SignalNames
from levid.identification.results import IdentificationResult
from levid.identification.subspace.plant_from_loop import IdentifiedPlant
from levid.identification.subspace.simulation import simulate
from levid.model.second_order import StateSpace, discretise

FREQ_HZ = np.geomspace(0.5, 20.0, 15)
# Both solve the same 4 x 4 equations in double precision with a condition of at most 1e3.
SAME = 1e-12

MODEL = StateSpace(
    np.array([[0.95, 0.2, 0.0, 0.0], [-0.2, 0.95, 0.0, 0.0], [0, 0, 0.8, 0.4], [0, 0, -0.4, 0.8]]),
    np.array([[0.0, 0.3, 1.0], [1.0, 0.0, 0.0], [0.5, 1.0, 0.0], [0.0, 0.5, 2.0]]),
    np.array([[1.0, 0.0, 0.5, 0.0], [0.0, 0.5, 1.0, 0.0]]),
    np.array([[0.0, 0.0, 0.2], [0.1, 0.0, 0.0]]),
    0.02,
)
PLANT = IdentifiedPlant(MODEL, delay_steps=2, lag_pole=0.3)
SIGNALS = SignalNames(("a", "b", "c"), ("N", "N", "N m"), ("p", "q"), ("m", "rad"), MODEL.Ts_s)


@pytest.fixture
def control():
    return pytest.importorskip("control", reason="python-control is not installed")


@pytest.mark.parametrize("model", [MODEL, PLANT], ids=["model", "with delay and lag"])
def test_python_control_evaluates_the_same_response(control, model):
    system = control_state_space(model, SIGNALS)
    assert isinstance(system, control.StateSpace)
    assert (system.dt, system.noutputs, system.ninputs) == (0.02, 2, 3)
    assert (system.input_labels, system.output_labels) == (["a", "b", "c"], ["p", "q"])
    theirs = system(np.exp(2j * np.pi * FREQ_HZ * 0.02)).transpose(2, 0, 1)
    np.testing.assert_allclose(theirs, model.response(FREQ_HZ), rtol=SAME, atol=SAME)


def test_continuous_model_stays_continuous(control):
    model = StateSpace(
        np.array([[-2.0]]), np.array([[1.0]]), np.array([[3.0]]), np.zeros((1, 1)), 0
    )
    assert control_state_space(model).dt == 0
    assert isinstance(scipy_state_space(model), signal.lti)
    np.testing.assert_allclose(control_state_space(model)(0), 1.5, rtol=SAME)


def test_python_control_object_has_the_measured_response(control):
    estimate = _estimate()
    frd = control_frd(estimate, SIGNALS)
    assert isinstance(frd, control.FRD)
    assert (frd.dt, frd.input_labels, frd.output_labels) == (0.02, ["a", "b", "c"], ["p", "q"])
    for f, freq_hz in enumerate(FREQ_HZ):
        np.testing.assert_array_equal(frd.eval(2 * np.pi * freq_hz), estimate.H[f])


def test_missing_python_control_gives_an_error_with_the_package_name(monkeypatch):
    monkeypatch.setitem(sys.modules, "control", None)  # makes the import fail
    for call in (lambda: control_state_space(MODEL), lambda: control_frd(_estimate())):
        with pytest.raises(
            ModuleNotFoundError, match=r"python-control.*pip install levid\[control\]"
        ):
            call()


def test_scipy_simulates_the_same_output():
    system = scipy_state_space(PLANT)
    assert isinstance(system, signal.dlti)
    assert system.dt == 0.02
    u = np.random.default_rng(1).normal(size=(200, 3))
    _, theirs, _ = signal.dlsim(system, u)
    np.testing.assert_allclose(theirs, simulate(PLANT.state_space(), u), rtol=SAME, atol=SAME)


def test_mat_file_has_models_and_responses_of_all_positions(rig, tmp_path):
    result = _identified(rig, (-0.1, 0.1))
    write_mat(tmp_path / "plant.mat", result)
    mat = loadmat(tmp_path / "plant.mat")
    first, second = result.points
    n, frequencies = len(first.recommended.state_space().A), len(first.freq_hz)
    assert mat["A"].shape == (n, n, 2)
    assert mat["B"].shape == (n, 3, 2)
    assert mat["C"].shape == (3, n, 2)
    assert mat["D"].shape == (3, 3, 2)
    assert (
        mat["frf"].shape == mat["frf_sd"].shape == (3, 3, frequencies, 2)
    )  # the layout of MATLAB's idfrd
    assert mat["freq"].shape == (frequencies, 1)
    assert mat["Ts"].item() == 1e-3
    np.testing.assert_allclose(mat["beam_m"], [[-0.1, 0.1]])
    assert [name.item() for name in mat["input_names"][0]] == ["psi", "theta", "z"]
    assert [unit.item() for unit in mat["output_units"][0]] == ["rad", "rad", "m"]
    assert [name.item() for name in mat["method"][0]] == ["subspace", "subspace"]
    np.testing.assert_array_equal(mat["trusted"], [[1.0, 1.0]])
    for k, point in enumerate((first, second)):
        model = StateSpace(*(mat[name][:, :, k] for name in "ABCD"), mat["Ts"].item())
        best = point.recommended
        np.testing.assert_array_equal(model.response(FREQ_HZ), best.state_space().response(FREQ_HZ))
        np.testing.assert_array_equal(
            mat["frf"][..., k].transpose(2, 0, 1), point.from_sensitivity.H
        )


def test_mat_file_marks_an_untrusted_model(rig, tmp_path):
    result = _identified(rig, (0.0,))
    (point,) = result.points
    doubted = replace(point, subspace=None, doubts=("it is unstable",))
    write_mat(tmp_path / "plant.mat", replace(result, points=(doubted,)))
    mat = loadmat(tmp_path / "plant.mat")
    assert mat["trusted"].item() == 0.0
    assert mat["method"].item().item() == "ho_kalman"
    assert len(mat["A"]) == len(point.plant.state_space().A)


def test_mat_file_of_one_position_has_plain_matrices(rig, tmp_path):
    write_mat(tmp_path / "plant.mat", _identified(rig, (0.0,)))
    mat = loadmat(tmp_path / "plant.mat")
    assert mat["A"].ndim == 2
    assert mat["frf"].ndim == 3


def test_mat_file_keeps_positions_of_different_order_apart(rig, tmp_path):
    one, other = _identified(rig, (0.0,), order=9), _identified(rig, (0.1,), order=10)
    points = tuple(replace(p, subspace=None) for p in one.points + other.points)
    both = IdentificationResult(one.signals, points)
    write_mat(tmp_path / "plant.mat", both)
    mat = loadmat(tmp_path / "plant.mat")
    assert mat["A"].shape == (1, 2)
    assert [len(A) for A in mat["A"][0]] == [len(p.plant.state_space().A) for p in both.points]
    assert [name.item() for name in mat["method"][0]] == ["ho_kalman", "ho_kalman"]
    assert mat["frf"].shape[-1] == 2  # the responses are at the same frequencies


def test_mat_file_loads_in_octave(rig, tmp_path):
    octave = shutil.which("octave-cli")
    if octave is None:
        pytest.skip("GNU Octave is not installed")
    result = _identified(rig, (-0.1, 0.1))
    write_mat(tmp_path / "plant.mat", result)
    script = (
        "load plant.mat; z = exp(2i * pi * freq(7) * Ts); k = 2;"
        "P = C(:,:,k) * ((z * eye(rows(A)) - A(:,:,k)) \\ B(:,:,k)) + D(:,:,k);"
        "for x = [P(2,3), frf(2,3,7,k)], printf('%.17g %.17g ', real(x), imag(x)); end;"
        "printf('%s %s', input_names{3}, output_units{2});"
    )
    run = subprocess.run(
        [octave, "--norc", "--eval", script],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    *numbers, name, unit = run.stdout.split()
    model, measured = (complex(float(a), float(b)) for a, b in (numbers[:2], numbers[2:]))
    point = result.points[1]
    # Octave solves 12 equations with its own solver; numbers are printed exactly.
    np.testing.assert_allclose(model, point.plant.response(point.freq_hz[6:7])[0, 1, 2], rtol=1e-8)
    assert measured == point.from_sensitivity.H[6, 1, 2]
    assert (name, unit) == ("z", "rad")


def _approximation(beam_m: float) -> BestLinearApproximation:
    H = PLANT.response(FREQ_HZ)
    F, m, p = H.shape
    covariance = np.zeros((F, m, p, m, p), complex)
    for i in range(m):
        for j in range(p):
            covariance[:, i, j, i, j] = 4e-6
    rms = np.ones((F, m))
    nothing = DetectionLines(np.empty(0), np.empty((0, m)), np.empty((0, m)), 1, 1)
    return BestLinearApproximation(
        freq_hz=FREQ_HZ,
        H=H,
        covariance=covariance,
        noise_covariance=covariance / 4,
        distortion_variance=np.full(H.shape, 9e-6),
        freedom=6,
        noise_freedom=6,
        output_level=rms,
        total_level=rms,
        noise_level=rms,
        even=nothing,
        odd=nothing,
        Ts_s=SIGNALS.Ts_s,
        input_names=SIGNALS.input_names,
        input_units=SIGNALS.input_units,
        output_names=SIGNALS.output_names,
        output_units=SIGNALS.output_units,
        beam_m=beam_m,
        records=("r",),
    )


def test_mat_file_of_multisines_has_response_errors_and_names(tmp_path):
    write_multisine_mat(tmp_path / "m.mat", [_approximation(-0.1), _approximation(0.1)])
    mat = loadmat(tmp_path / "m.mat")
    np.testing.assert_array_equal(mat["frf"][..., 1].transpose(2, 0, 1), PLANT.response(FREQ_HZ))
    assert mat["freq"].shape == (len(FREQ_HZ), 1)
    for name, deviation in (("frf_sd", 2e-3), ("frf_noise_sd", 1e-3), ("frf_distortion_sd", 3e-3)):
        np.testing.assert_allclose(mat[name], deviation)
        assert mat[name].shape == mat["frf"].shape
    np.testing.assert_allclose(mat["beam_m"], [[-0.1, 0.1]])
    assert mat["Ts"].item() == SIGNALS.Ts_s
    assert [name.item() for name in mat["input_names"][0]] == list(SIGNALS.input_names)
    assert [unit.item() for unit in mat["output_units"][0]] == list(SIGNALS.output_units)


@pytest.mark.parametrize("hold", ["zoh", "foh", "band_limited"])
def test_mat_file_of_a_fitted_model_has_its_input_hold(tmp_path, hold):
    grey = _fitted(hold)
    write_fitted_mat(tmp_path / "fitted.mat", grey)
    mat = loadmat(tmp_path / "fitted.mat")
    again = StateSpace(*(mat[name] for name in "ABCD"), mat["Ts"].item())
    late = np.exp(-2j * np.pi * FREQ_HZ * mat["input_delay_s"].item())
    np.testing.assert_allclose(
        again.response(FREQ_HZ) * late[:, None, None], grey.response({}, FREQ_HZ), rtol=SAME
    )
    assert mat["input_hold"].item() == hold
    assert again.Ts_s == (0.0 if hold == "band_limited" else grey.Ts_s)
    assert mat["input_units"][0, 0].item() == grey.declared.inputs[0].unit
    name, value = next(iter(grey.fitted.parameters.items()))
    assert mat["parameters"][name].item().item() == value.value


def test_mat_file_takes_parameters_of_any_name_with_their_errors(tmp_path):
    # MATLAB allows 63 characters, scipy writes 31 by default.
    same = "mass_of_everything_that_hangs_below_the_platform_and_its_three_magnets"
    names = ("_k", "a" * 40, same + "_1", same + "_2", "p__k")
    grey = _fitted("zoh")
    known = next(iter(grey.fitted.parameters.values()))
    parameters = {name: known.model_copy(update={"value": float(i), "se": 0.5 * i or None})
                  for i, name in enumerate(names)}  # fmt: skip
    fitted = grey.fitted.model_copy(update={"parameters": parameters})
    write_fitted_mat(tmp_path / "fitted.mat", replace(grey, fitted=fitted))
    mat = loadmat(tmp_path / "fitted.mat")
    fields = mat["parameters"].dtype.names
    assert fields == ("p__k", "a" * 40, same[:63], f"{same[:59]}_2", "p__k_2")
    assert mat["standard_errors"].dtype.names == fields
    for i, field in enumerate(fields):
        assert mat["parameters"][field].item().item() == i
        np.testing.assert_array_equal(
            mat["standard_errors"][field].item().item(), 0.5 * i if i else np.nan
        )


def _fitted(hold: str) -> GreyBox:
    """Fit a circuit to data with a zero-order hold; the model declares `hold`."""
    config = load_model(shipped("models/silverbox.yaml")).model_copy(update={"input": hold})
    rng, Ts_s = np.random.default_rng(1), 1 / 610.35
    u = rng.normal(size=(3000, 1))
    y = simulate(discretise(declared_model(config).at(), Ts_s), u)
    y += 1e-4 * rng.normal(size=u.shape)
    record = Experiment("made", Ts_s, u, y, {}, frozenset(), False)
    return identify_grey_box(config, [record], 0.25)


def _estimate() -> ResponseEstimate:
    H = PLANT.response(FREQ_HZ)
    return ResponseEstimate(FREQ_HZ, H, np.ones(H.shape), np.zeros((*H.shape, 2, 3), complex), 0.02)


def _identified(rig, beams: tuple[float, ...], order: int = 9) -> IdentificationResult:
    """Identify short records: the tests check the file, not the estimates."""
    records = rig.records(beams, 1000.0, 8.0)
    return identify(records, Options(order=order, impulse_s=0.5, segment_s=2.0, lag_s=rig.LAG_S))
