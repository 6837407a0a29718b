"""Plan a client's request: parse it, check it against the rig, compute its plan."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from ...config.base import ConfigError, parse, parse_text
from ...config.rig import RigConfig
from ...config.session import CoilCheck, Land, Levitate, Move, SessionConfig, Step
from ..control.preflight_findings import Check, check_names
from ..control.states import State
from .plan import MOST_CYCLES, Plan, checked_note, plan_session, plan_steps
from .plan_memory_file import PlannedRequest
from .predicted_motion import motion_finding
from .refused_request import RELOADED, RefusedError, Situation, override_hint, wrong_state

Request = Mapping[str, Any]


class Planner:
    """Plan requests for one rig, without access to files or devices."""

    def __init__(self, rig: RigConfig) -> None:
        self._rig = rig
        self.recording = rig.recording
        self._ops = {"excite": self._session, "levitate": self._lift_off, "move": self._move}

    def plan(self, line: bytes, situation: Situation) -> PlannedRequest:
        """Plan one request, given as a line of JSON.

        Raises:
            RefusedError, ConfigError: the request is invalid or cannot be flown.
        """
        try:
            request = json.loads(line)
        except (ValueError, RecursionError):
            raise RefusedError("expected one line with a JSON object that has 'op'") from None
        op = request.get("op") if isinstance(request, dict) else None
        if not isinstance(op, str) or op not in self._ops:
            raise RefusedError(
                f"op: expected one of {', '.join(self._ops)} in a request of this length, found "
                f"{_short(op)}"
            )
        gone = request.get("client_gone")
        if gone not in (None, "", "go_on", "land"):
            raise RefusedError(f"client_gone: expected go_on or land, found {_short(gone)}")
        return self._ops[op](request, situation)

    def _session(self, request: Request, situation: Situation) -> PlannedRequest:
        text, out = request.get("session"), request.get("out")
        if not isinstance(text, str) or not isinstance(out, str):
            raise RefusedError("excite: expected 'session' (YAML text) and 'out' (a folder)")
        if not out:
            raise RefusedError("excite: 'out': expected a folder, found an empty name")
        _require_rest("excite", situation)
        self._check_rig(request.get("rig"))
        session = parse_text(text, SessionConfig, "session")
        if session.rate_hz not in (None, self._rig.rate_hz):
            raise ConfigError(
                f"session {session.name}: rate_hz: expected {self._rig.rate_hz:g} Hz, as in the "
                f"daemon's rig, found {session.rate_hz:g} Hz"
            )
        self._require_length(session.name, least_cycles(session, self._rig.rate_hz))
        check, note = self._due_check(session.steps[0].levitate, situation)
        plan = plan_session(session, self._rig, situation.beam_m, situation.rotor_rad, check=check)
        note = "; ".join(filter(None, [note, self._check_motion(plan, request)]))
        land = session.steps[-1].land or Land()
        return self._planned("excite", plan, request, land, out, text.encode(), note)

    def _check_motion(self, plan: Plan, request: Request) -> str:
        """Return a note if the predicted motion exceeds a limit and the client overrides that."""
        finding = motion_finding(self._rig, plan)
        if not finding.failed:
            return ""
        if finding.check not in _override(request):
            raise RefusedError(f"not ready to lift off: {finding}{override_hint(finding.check)}")
        return f"preflight check failed, overridden by the client: {finding}"

    def _lift_off(self, request: Request, situation: Situation) -> PlannedRequest:
        _require_rest("levitate", situation)
        levitate = parse(request.get("levitate") or {}, Levitate, "levitate")
        land = parse(request.get("land") or {}, Land, "land")
        check, note = self._due_check(levitate, situation)
        plan = self._by_hand(Step(levitate=levitate), situation, check)
        out = request.get("out")
        if out is not None and (not isinstance(out, str) or not out):
            raise RefusedError(f"levitate: expected 'out' (a folder), found {_short(out)}")
        return self._planned("levitate", plan, request, land, out or "", b"", note)

    def _move(self, request: Request, situation: Situation) -> PlannedRequest:
        move = parse(request.get("move") or {}, Move, "move")
        if situation.state is not State.LEVITATING:
            raise RefusedError(f"move: {wrong_state(situation.state, State.LEVITATING)}")
        plan = self._by_hand(Step(move=move), situation)
        return self._planned("move", plan, request, None, "", b"", "")

    def _by_hand(self, step: Step, situation: Situation, check: CoilCheck | None = None) -> Plan:
        beam_m, rotor_rad = situation.beam_m, situation.rotor_rad
        return plan_steps([step], step.kind, self._rig, beam_m, rotor_rad, check)

    def _due_check(
        self, levitate: Levitate | None, situation: Situation
    ) -> tuple[CoilCheck | None, str]:
        """Return the default coil check of a lift-off, None for none, and a note for the journal.

        A rig that cannot perform the default check flies without it; the note says why.
        """
        if levitate is None or levitate.check_coils is not None or situation.coils_known:
            return None, ""
        check = CoilCheck()
        try:
            self._by_hand(Step(levitate=levitate), situation, check)
        except ConfigError as error:
            return None, f"coil check after lift-off skipped: {error}"
        return check, ""

    def _planned(
        self,
        op: str,
        plan: Plan,
        request: Request,
        land: Land | None,
        out: str,
        session: bytes,
        note: str,
    ) -> PlannedRequest:
        rate_hz = self._rig.rate_hz
        self._require_length(plan.name, plan.cycles)
        landing = None
        if land is not None:
            landing = round(land.ramp_s * rate_hz), round(land.release_s * rate_hz)
            self._require_length(f"{plan.name}: land", sum(landing))
        plan = replace(plan, note=checked_note(request.get("note")))
        gone = str(request.get("client_gone") or "")
        override = _override(request)
        return PlannedRequest(op, plan, out, landing, gone, session, note, override)

    def _require_length(self, name: str, cycles: int) -> None:
        rate_hz = self._rig.rate_hz
        if cycles > MOST_CYCLES:
            raise RefusedError(
                f"{name}: expected a total of at most {MOST_CYCLES / rate_hz:g} s at "
                f"{rate_hz:g} Hz, found {cycles / rate_hz:g} s; fly several sessions"
            )

    def _check_rig(self, text: object) -> None:
        """Raise ConfigError if the client's rig differs from the rig of this daemon."""
        if text is None:
            return
        rig = parse_text(str(text), RigConfig, "rig")
        if isinstance(rig.model, str) and self._rig.model is not None:
            # A relative path refers to the client's folder, which the daemon does not know.
            rig = rig.model_copy(update={"model": self._rig.model})
        if _as_started(rig) != _as_started(self._rig):
            raise ConfigError(
                f"rig {rig.name}: it differs from the rig of the daemon; restart the daemon with it"
            )


def _override(request: Request) -> tuple[Check, ...]:
    names = request.get("override") or []
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise RefusedError("override: expected a list of names of preflight checks")
    try:
        return check_names(names)
    except ValueError as error:
        raise RefusedError(f"override: {error}") from None


def least_cycles(session: SessionConfig, rate_hz: float) -> int:
    """Return a lower bound of a session's cycles, without its moves.

    It serves to refuse sessions that are far too long, which would take hours to plan.
    """

    def cycles(*parts_s: float | None) -> int:
        return sum(int((part_s or 0.0) * rate_hz) for part_s in parts_s)

    total = 0
    for step in session.steps:
        if step.levitate is not None:
            total += cycles(step.levitate.unload_s, step.levitate.ramp_s, step.levitate.settle_s)
        elif step.move is not None:
            total += cycles(step.move.settle_s)
        elif step.land is not None:
            total += cycles(step.land.ramp_s, step.land.release_s)
        elif step.record is not None:
            record, inputs = step.record, len(step.record.excite)
            total += cycles(record.settle_s, record.duration_s) + inputs * cycles(record.each_s)
            if record.orthogonal is not None:
                periods = record.orthogonal.realisations * inputs * record.orthogonal.periods
                total += periods * cycles(session.excitations[record.excite[0]].period_s)
    return total


def _require_rest(op: str, situation: Situation) -> None:
    """Raise RefusedError unless the state is IDLE, before the effort of planning."""
    if situation.state is not State.IDLE:
        raise RefusedError(f"{op}: {wrong_state(situation.state, State.IDLE)}")


def _as_started(rig: RigConfig) -> RigConfig:
    """Return a rig with defaults for the keys that can be reloaded."""
    plain = type(rig.service)()
    fixed = {key: getattr(plain, key) for key in RELOADED}
    return rig.model_copy(update={"service": rig.service.model_copy(update=fixed)})


def _short(value: object) -> str:
    text = repr(value) if not isinstance(value, (dict, list)) else type(value).__name__
    return text if len(text) <= 60 else f"{text[:57]}..."
