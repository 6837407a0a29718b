"""State the result of a trace in sentences that anyone at the rig understands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ..session.session_page import listed


@dataclass(frozen=True)
class Clause:
    """One effect in words; `others` are effects that the records do not tell from it.

    doubtful: whether another effect may be the cause. free: a free form, no known effect.
    """

    text: str
    others: tuple[str, ...] = ()
    doubtful: bool = False
    free: bool = False


def answer(clauses: Sequence[Clause], rest: str) -> str:
    """Return the answer: effects without doubt, ambiguous and doubtful ones, and what is left.

    rest: a sentence on the remaining error.
    """
    sentences = []
    named = [c.text for c in clauses if not (c.others or c.doubtful or c.free)]
    if named:
        sentences.append(_sentence(listed(named)))
    for clause in clauses:
        if clause.others:
            either = f"either {clause.text}, or the cause is: {listed(list(clause.others))}"
            sentences.append(_sentence(f"{either}; these records cannot tell which"))
        elif clause.free:
            sentences.append(
                _sentence(f"an unknown effect remains, described by a free form: {clause.text}")
            )
        elif clause.doubtful:
            sentences.append(_sentence(f"perhaps {clause.text}"))
    return " ".join([*sentences, rest])


def _sentence(clause: str) -> str:
    return f"{clause[0].upper()}{clause[1:]}."
