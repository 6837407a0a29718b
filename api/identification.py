"""Hold the result of an identification: parameters, modes, plants, plots, report."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ..config.escaping import html_text
from ..config.sim import SimConfig
from ..identification.greybox.identify_greybox import GreyBox
from ..identification.records.record import IdentificationError
from ..identification.results import ClosedLoopPoint, OpenLoopPoint
from ..identification.run_identification import Study
from ..log.catalogue.results import RESULT
from .model import Model, Parameter, Parameters, model_of_config
from .output_folder import claimed_folder
from .plant import Mode, Modes, Plant, beam_text, plant_of
from .read_only_arrays import with_read_only_arrays
from .result_file import REPORT_FILES, REPORT_FOLDERS, save_result, with_origin

if TYPE_CHECKING:
    import control
    from matplotlib.figure import Figure

    from ..identification.records.signal_names import SignalNames
    from ..report.identification.closed_loop import Truth
    from .session import Session

Method = Literal["recommended", "subspace", "ho_kalman", "prediction_error", "fitted"]
_SAME_POSITION_M = 1e-3


class Identification:
    """An identified plant: models by several methods, parameters, modes, plots and report.

    `parameters` are those of the declared model, fitted to all records. `plant` returns a model in
    state space. `notes` lists logs left out, and models that should not be used.
    """

    def __init__(
        self, session: Session, found: Study, simulator: SimConfig | None, flown: bool
    ) -> None:
        """Hold the results of a study; `simulator` gives the true response, if known."""
        self._session, self._found, self._flown = session, found, flown
        self._simulator = simulator
        self._page: Path | None = None

    @cached_property
    def results(self) -> Study:
        """The results of all methods as computed; not a part of the stable API."""
        return with_read_only_arrays(replace(self._found, notes=self.notes))

    @property
    def notes(self) -> tuple[str, ...]:
        """Logs left out with the reason, and models that should not be used."""
        grey = self._found.grey
        remarks = () if grey is None else grey.remarks
        return tuple(dict.fromkeys((*self._found.notes, *remarks)))

    @cached_property
    def answer(self) -> str:
        """The model to use, or why there is none: the sentences with which the report begins."""
        try:
            from ..report.identification.chapters import identification_answer
        except ImportError as error:  # its sentences stand beside the figures
            return f"The answer in words needs matplotlib, which cannot be imported: {error}."

        found = self._found
        return identification_answer(found.points, found.grey, found.multisine)

    @property
    def page(self) -> Path | None:
        """Path of the report's page; None before `report` was called."""
        return self._page

    @property
    def session(self) -> Session:
        """The identified session."""
        return self._session

    @property
    def model(self) -> Model:
        """The declared model, fitted to all records.

        Raises:
            IdentificationError: no model was fitted.
        """
        grey = self._grey()
        return model_of_config(grey.fitted, grey.declared)

    @property
    def parameters(self) -> Parameters:
        """Parameters of the fitted model by name; empty if no model was fitted."""
        return Parameters({}) if self._found.grey is None else self.model.parameters

    @property
    def beam_m(self) -> tuple[float | None, ...]:
        """Beam positions in m that were identified, in ascending order; None without a beam."""
        return tuple(point.beam_m for point in self._points)

    @property
    def modes(self) -> Modes:
        """Modes of the recommended plants with standard errors; empty if there are none."""
        found = []
        for point in self._points:
            if isinstance(point, OpenLoopPoint):
                modes = point.modes
            elif point.subspace is not None and point.subspace.trusted:
                modes = point.subspace.modes
            else:
                continue
            for f, f_se, d, d_se in zip(
                modes.frequency_hz.tolist(), modes.frequency_se_hz.tolist(),
                modes.damping.tolist(), modes.damping_se.tolist(), strict=True,
            ):  # fmt: skip
                frequency = Parameter("frequency", f, _finite(f_se), "Hz")
                damping = Parameter("damping", d, _finite(d_se), "1")
                found.append(Mode(frequency, damping, point.beam_m))
        return Modes(found)

    def plant(self, method: Method = "recommended", beam_m: float | None = None) -> Plant:
        """Return the plant at a beam position in state space, with delay and lag as states.

        Args:
            method: "recommended": the best model of the records; "subspace", "ho_kalman" in a
                known loop; "prediction_error" without one; "fitted": the declared model.
            beam_m: beam position in m, needed if several were identified; for "fitted" any
                position that the model covers.

        Raises:
            IdentificationError: there is no such model; the message lists those that exist.
        """
        if method == "fitted" or (method == "recommended" and not self._points):
            return self._fitted_plant(beam_m)
        point = self._point(beam_m)
        models = self._models(point)
        if method == "recommended" and models:
            method = self._recommended(point)
        if method not in models:
            names = ", ".join([*models, *([] if self._found.grey is None else ["fitted"])])
            raise IdentificationError(
                f"method: expected one of {names or 'no method, as none succeeded'}; found "
                f"'{method}'"
            )
        return plant_of(method, models[method], self.signals, point.beam_m)

    def to_control(
        self, method: Method = "recommended", beam_m: float | None = None
    ) -> control.StateSpace:
        """Return `plant(method, beam_m)` as a python-control StateSpace.

        Raises:
            ImportError: python-control is not installed.
            IdentificationError: there is no such model.
        """
        return self.plant(method, beam_m).to_control()

    def to_json(self) -> dict[str, Any]:
        """Return the object that `levid identify --json` prints: dicts, lists, numbers, text.

        `report` is the path of the page, None before `report` was called.
        """
        from ..identification.results_to_json import study_summary

        s = self.signals
        named = {
            "Ts_s": s.Ts_s,
            "inputs": _pairs(s.input_names, s.input_units),
            "outputs": _pairs(s.output_names, s.output_units),
        }
        page = None if self._page is None else str(self._page)
        plain = {**named, **study_summary(self.results), "report": page}
        plain["answer"] = self.answer
        return with_origin("identify", self._session.logs, plain)

    def report(self, folder: str | Path, command: str = "") -> Path:
        """Write the report, result.json, and model.yaml of the fitted model; return the page.

        The page ends with `command`, which repeats the identification.

        Raises:
            ConfigError: the folder cannot be written.
        """
        from .next_flight import next_flight
        from .session import first_flight

        out, found = Path(folder), self._found
        with claimed_folder(out, REPORT_FILES, REPORT_FOLDERS):
            # Save the model first: the results of a long fit survive an error in the report.
            if found.grey is not None:
                self.model.save(out / "model.yaml")
            save_result(out, self.to_json())
            from ..report.identification.chapters import Commands
            from ..report.identification.identification_page import identification_report
            from ..report.session.flight_data import read_session

            self._page = identification_report(
                found.points,
                read_session(first_flight(self._session.logs)) if self._flown else None,
                out,
                self.truth,
                found.grey,
                found.multisine,
                found.notes,
                Commands(command, self._session.logs, partial(next_flight, self._session)),
            )
            save_result(out, self.to_json())
        return self._page

    def save(self, folder: str | Path) -> Path:
        """Write model.yaml, result.json and identified.mat to `folder`, without a report.

        model.yaml is written only if a model was fitted. Returns the folder.

        Raises:
            ConfigError: the folder cannot be written.
        """
        out = Path(folder)
        with claimed_folder(out, ("model.yaml", RESULT, "identified.mat")):
            if self._found.grey is not None:
                self.model.save(out / "model.yaml")
            save_result(out, self.to_json())
            self.write_mat(out)
        return out

    def write_mat(self, folder: str | Path) -> None:
        """Write a .mat file for MATLAB and Octave for each kind of result.

        The first is identified.mat; multisine.mat follows if both kinds of records are there.
        """
        from ..identification.export import write_fitted_mat, write_mat, write_multisine_mat

        found, first = self._found, Path(folder) / "identified.mat"
        if found.points is not None:
            write_mat(first, found.points)
            if found.multisine:
                write_multisine_mat(Path(folder) / "multisine.mat", found.multisine)
        elif found.multisine:
            write_multisine_mat(first, found.multisine)
        elif found.grey is not None:
            write_fitted_mat(first, found.grey)

    def plot(self, kind: Literal["bode", "outputs"] = "bode") -> Figure:
        """Draw the result.

        Args:
            kind: "bode": magnitude and phase of the recommended plants with 95 % intervals;
                "outputs": measured and simulated outputs on held-out data.

        Raises:
            IdentificationError: there is no such plot.
        """
        from .identification_plots import bode_plot, outputs_plot

        kinds = {"bode": bode_plot, "outputs": outputs_plot}
        if kind not in kinds:
            raise IdentificationError(f"kind: expected one of {', '.join(kinds)}; found {kind!r}")
        return kinds[kind](self)

    @property
    def signals(self) -> SignalNames:
        """Names and units of the identified inputs and outputs, and the sampling time."""
        from ..identification.export import fitted_signals

        found = self._found
        if found.points is not None:
            return found.points.signals
        if found.multisine:
            return found.multisine[0].signals
        return fitted_signals(self._grey())  # a study that found nothing is an error

    @cached_property
    def truth(self) -> Truth | None:
        """True response of a simulated plant at a beam position and frequencies, if given."""
        if self._simulator is None:
            return None
        from ..sim.true_response import frequency_response

        config, rate_hz = self._simulator, 1.0 / self.signals.Ts_s
        return lambda beam_m, freq_hz: frequency_response(config, beam_m or 0.0, freq_hz, rate_hz)

    def __repr__(self) -> str:
        parts = [f"<Identification of {self._session.name}: {self._summary()}>"]
        parts += [text for text in (repr(self.parameters), repr(self.modes)) if "no " not in text]
        return "\n".join([*parts, *(f"note: {note}" for note in self._important_notes())])

    def _repr_html_(self) -> str:
        parts = [
            f"<p><b>Identification of {html_text(self._session.name)}</b>: "
            f"{html_text(self._summary())}</p>"
        ]
        if self.parameters:
            parts.append(self.parameters._repr_html_())
        if self.modes:
            parts.append(self.modes._repr_html_())
        parts += [f"<p>note: {html_text(note)}</p>" for note in self._important_notes()]
        return "".join(parts)

    def _summary(self) -> str:
        s = self.signals
        parts = [f"{', '.join(s.input_names)} to {', '.join(s.output_names)}"]
        for point in self._points:
            at = "" if point.beam_m is None else f", beam at {beam_text(point.beam_m)}"
            parts.append(f"{self._recommended(point)} of order {_order(point)}{at}")
        if self._found.multisine:
            parts.append("multisine response")
        if self._found.grey is not None:
            parts.append(f"{len(self.parameters)} parameters fitted")
        return "; ".join(parts)

    def _important_notes(self) -> list[str]:
        from ..identification.records.record import OTHER_STEP

        return [note for note in self.notes if OTHER_STEP not in note]

    @property
    def _points(self) -> Sequence[ClosedLoopPoint | OpenLoopPoint]:
        return () if self._found.points is None else self._found.points.points

    def _point(self, beam_m: float | None) -> ClosedLoopPoint | OpenLoopPoint:
        if beam_m is None and len(self._points) == 1:
            return self._points[0]
        for point in self._points:
            at = point.beam_m
            if at is None or (beam_m is not None and abs(at - beam_m) <= _SAME_POSITION_M):
                return point
        known = ", ".join(f"{at:.4g}" for at in self.beam_m if at is not None) or "none"
        found = "none" if beam_m is None else f"{beam_m:g} m"
        raise IdentificationError(
            f"beam_m: expected one of the identified positions {known} m, found {found}; "
            "method='fitted' serves any position"
        )

    def _models(self, point: ClosedLoopPoint | OpenLoopPoint) -> dict[str, Any]:
        if isinstance(point, OpenLoopPoint):
            return {"prediction_error": point.model}
        models = {} if point.subspace is None else {"subspace": point.subspace.plant.state_space()}
        return {**models, "ho_kalman": point.plant.state_space()}

    def _recommended(self, point: ClosedLoopPoint | OpenLoopPoint) -> Method:
        if isinstance(point, OpenLoopPoint):
            return "prediction_error"
        if point.subspace is not None and point.recommended is point.subspace.plant:
            return "subspace"
        return "ho_kalman"

    def _fitted_plant(self, beam_m: float | None) -> Plant:
        grey = self._grey()
        beam = [
            name
            for name, variable in grey.declared.scheduling.items()
            if variable.signal == "beam_m" and not variable.derivative
        ]
        if beam_m is not None and not beam:
            raise IdentificationError(
                f"beam_m: expected none for a model without a beam, found {beam_m:g} m"
            )
        schedule = {} if beam_m is None else {beam[0]: beam_m}
        model, delay_s = grey.state_space(schedule)
        from ..identification.export import fitted_signals

        at = (0.0 if beam_m is None else beam_m) if beam else None
        return plant_of("fitted", model, fitted_signals(grey), at, delay_s)

    def _grey(self) -> GreyBox:
        if self._found.grey is None:
            raise IdentificationError(
                "expected a fitted model, found none: pass model='MODEL.yaml' to identify"
                + "".join(f"; {n}" for n in self.notes if "declared model was not fitted" in n)
            )
        return self._found.grey


def _order(point: ClosedLoopPoint | OpenLoopPoint) -> int:
    if isinstance(point, OpenLoopPoint):
        return point.order
    plant = point.recommended or point.plant
    return len(plant.core.A)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _pairs(names: Sequence[str], units: Sequence[str]) -> list[dict[str, str]]:
    return [{"name": name, "unit": unit} for name, unit in zip(names, units, strict=True)]
