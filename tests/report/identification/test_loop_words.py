"""Test the answer on records in a loop: band, modes, and what is left."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from levid.benchmarks.identification.bending_platform import BendingMode, Platform, flights
from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.identification.greybox.fit_in_loop import FittedLoop, fit_in_loop
from levid.identification.greybox.modes.valid_band import valid_band
from levid.report.identification.loop_words import (
    loop_answer,
    loop_numbers,
    modes_table,
    shape_parts,
)
from levid.report.plotting.figure_to_svg import Picture
from levid.report.plotting.html_page import Text

RIGID_HZ, NOISE_MOST = 8.9, 1.5


@pytest.fixture(scope="module")
def bent() -> FittedLoop:
    shape = np.array([1, 0.2, -0.6, 0.1, -0.4, 0.3, 0.8, -0.2, 0.5])
    platform = Platform((BendingMode(95.0, 0.01, 3.0, shape),))
    model = load_model(shipped("models/rig.yaml"))
    return fit_in_loop(model, flights(platform, 1, duration_s=6.0), (), None)[1]


def test_answer_says_up_to_where_and_what_is_beyond(bent: FittedLoop) -> None:
    answer = loop_answer(bent, "rig", RIGID_HZ, NOISE_MOST)
    assert answer.startswith(f"Use the fitted model 'rig' up to {bent.band.end_hz:.3g}")
    assert "It lacks a mode that these records show: bending of the structure at 95 Hz." in answer
    assert f"{bent.over_noise:.2f} times the noise" in answer
    assert "comes neither from" not in answer


def test_no_tick_over_an_error_that_is_not_noise(bent: FittedLoop) -> None:
    assert [n.verdict for n in loop_numbers(bent, NOISE_MOST)] == ["good", "good"]
    worse = replace(bent, over_noise=1.6)
    assert [n.verdict for n in loop_numbers(worse, NOISE_MOST)] == ["none", "bad"]
    answer = loop_answer(worse, "rig", RIGID_HZ, NOISE_MOST)
    assert answer.startswith(
        "The fitted model 'rig' does not explain these records: even with bending of the structure "
        "at 95 Hz, the simulation error is 1.60 times the noise. It is valid up to "
        f"{bent.band.end_hz:.3g}"
    )


def test_a_residual_that_no_mode_explains_ends_the_band(bent: FittedLoop) -> None:
    residuals = []
    for point, found in zip(bent.fit.points, bent.fit.residuals, strict=True):
        error = found.clear_error.copy()
        error[point.freq_hz > 5.0, 2] = 0.2**2
        residuals.append(replace(found, clear_error=error))
    fit = replace(bent.fit, residuals=tuple(residuals), worst=50.0, worst_hz=5.5)
    band = valid_band(fit)
    assert not band.by_mode
    assert band.output == 2
    assert band.end_hz == pytest.approx(5.0, abs=0.5)
    answer = loop_answer(replace(bent, fit=fit, band=band), "rig", RIGID_HZ, NOISE_MOST)
    assert answer.startswith("The fitted model 'rig' does not explain these records: from 5")


def test_a_nonlinear_part_is_said_with_its_frequency_and_size(bent: FittedLoop) -> None:
    first = bent.fit.residuals[0]
    error = first.clear_error.copy()
    error[np.abs(bent.fit.points[0].freq_hz - 95.0) < 1.0, 1] = 0.05**2
    residuals = (replace(first, clear_error=error), *bent.fit.residuals[1:])
    fit = replace(bent.fit, residuals=residuals, worst=12.0, worst_hz=95.0)
    answer = loop_answer(replace(bent, fit=fit), "rig", RIGID_HZ, NOISE_MOST)
    assert "At 95 Hz 5 % of the response comes neither from it nor from a mode" in answer


def test_table_of_modes_has_intervals_and_a_shape(bent: FittedLoop) -> None:
    ((frequency, damping, kind, shape, unseen),) = modes_table(bent, ("psi", "theta", "z")).rows
    assert frequency.startswith("95.0") or frequency.startswith("94.9")
    assert "±" in damping
    assert kind == "bending of the structure"
    assert [part.split()[0] for part in shape.split(", ")] == ["psi", "theta", "z"]
    assert 50.0 < float(unseen.removesuffix(" %")) < 100.0


def test_picture_of_the_shapes_and_whether_coils_reach_them(bent: FittedLoop) -> None:
    picture, words = shape_parts(bent)
    assert isinstance(picture, Picture)
    assert "95 Hz" in picture.alt
    assert isinstance(words, Text)
    assert re.search(r"by reciprocity .* 95 Hz: coil 0 most; \d+ % of the", words.text)
    other = replace(bent.shapes[0], reach=None)
    (_, unknown) = shape_parts(replace(bent, shapes=(other,)))
    assert isinstance(unknown, Text)
    assert "Whether the coils reach these modes is unknown" in unknown.text
    assert shape_parts(replace(bent, shapes=(None,))) == ()
