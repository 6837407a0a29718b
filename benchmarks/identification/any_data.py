"""Import, identify and trace data sets of all kinds, and count answers that nobody should get.

Each seed draws a data set (`any_data_cases.py`). Every command has to end with a result without NaN
or with a refusal that says what was expected or what to do. No model is recommended of data that
cannot identify one. A case that does not end in time is listed: it is slow, not wrong.
"""

from __future__ import annotations

import importlib
import json
import multiprocessing
import os
import pkgutil
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import groupby
from pathlib import Path

from rich.table import Table

import levid.api
import levid.cli
import levid.identification
import levid.log
import levid.report
from levid.benchmarks.harness.benchmark_runner import Figure, Target, parser, show
from levid.benchmarks.identification.any_data_cases import Case, draw
from levid.cli.entry import main

CASES, QUICK = 300, 6
LIMIT_S = 120.0
"""Time that a case may take."""
_SHORTEST = 60
"""Characters of a refusal that can say what was expected, what was found and what to do."""
_REMEDIES = ("expected", "check", "record", "excite", "declare", "choose", "vary", "give", "set")
NONE = Target(most=0.0)


@dataclass
class Outcome:
    """What the commands of a case said: results and refusals by command, and what is wrong."""

    case: Case
    refused: dict[str, str] = field(default_factory=dict)
    answers: dict[str, str] = field(default_factory=dict)
    faults: list[tuple[str, str]] = field(default_factory=list)
    seconds: float = 0.0


def load_all() -> None:
    """Import all that the commands need: the processes of the cases inherit it."""
    for package in (levid.api, levid.cli, levid.report, levid.log, levid.identification):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            importlib.import_module(module.name)


def outcome(seed: int, limit_s: float) -> Outcome:
    """Run the commands on the data of a seed in a process of its own."""
    case = draw(seed)
    found = Outcome(case)
    folder = Path(tempfile.mkdtemp(prefix="any-data-"))
    child = multiprocessing.get_context("fork").Process(target=_commands, args=(case, folder))
    began = time.monotonic()
    child.start()
    child.join(limit_s)
    if child.is_alive():
        child.kill()
        child.join()
        found.faults.append(("too slow", f"not done after {limit_s:g} s"))
    found.seconds = time.monotonic() - began
    for done in sorted(folder.glob("*.code"), key=lambda path: path.stat().st_mtime):
        _judge(found, done)
    shutil.rmtree(folder)
    return found


def _commands(case: Case, folder: Path) -> None:
    """Run import, identify without and with the model, and trace."""
    os.chdir(folder)
    logs = []
    for k, (table, signals) in enumerate(case.write(folder)):
        name = f"import-{k}"
        if _run(name, ["import", str(table), "--signals", str(signals), "-o", f"r{k}.mcap"]) == 0:
            logs += sorted(map(str, Path().glob(f"r{k}*.mcap")))
    if not logs:
        return
    model = [] if case.model is None else ["--model", "model.yaml"]
    _run("identify", ["identify", *logs, "--out", "black", "--json"])
    if model:
        _run("identify-model", ["identify", *logs, *model, "--out", "grey", "--json"])
    _run("trace", ["trace", *logs, *model, "--out", "trace", "--json"])


def _run(name: str, arguments: list[str]) -> int:
    """Run one command as the console script does; keep what it prints, and its exit code."""
    code: object = 1
    for number, kind in ((1, "out"), (2, "err")):
        target = os.open(f"{name}.{kind}", os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
        os.dup2(target, number)
        os.close(target)
    sys.stdout, sys.stderr = (
        os.fdopen(number, "w", buffering=1, closefd=False) for number in (1, 2)
    )
    sys.argv = ["levid", *arguments]
    warnings.showwarning = _with_stack
    try:
        main()
    except SystemExit as end:
        code = end.code
    except BaseException:  # noqa: BLE001 - what a user would see
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    Path(f"{name}.code").write_text(str(code))
    return int(code) if isinstance(code, int) else 1


def _with_stack(message: Warning | str, category: type[Warning], *_: object) -> None:
    """Print a warning of a library with the lines that led to it."""
    stack = [f for f in traceback.extract_stack() if "site-packages" not in f.filename][-5:-1]
    lines = ", ".join(f"{Path(f.filename).name}:{f.lineno}" for f in stack)
    sys.stderr.write(f"{category.__name__}: {message} ({lines})\n")


def _judge(found: Outcome, done: Path) -> None:
    name = done.stem
    out, err = (done.with_suffix(f".{kind}").read_text() for kind in ("out", "err"))
    wrong = partial(_wrong, found, name)
    if "Traceback" in err:
        wrong("traceback", " | ".join(err.strip().splitlines()[-5:]))
        return
    if "Warning: " in err:
        wrong("warning of a library", next(t for t in err.splitlines() if "Warning: " in t))
    if "report is not" in err or "could not be drawn" in err:
        wrong("no report", err[-400:])
        return
    if done.read_text() != "0":
        refusal = err[err.rfind("error:") :] if "error:" in err else err
        found.refused[name] = refusal
        if len(refusal) < _SHORTEST or not any(word in refusal.lower() for word in _REMEDIES):
            wrong("refusal without a remedy", refusal)
        return
    if name.startswith("import"):
        return
    try:
        result = json.loads(out, parse_constant=_no_number)
    except ValueError as error:
        wrong("not JSON", f"{error}: {out[:200]}")
        return
    answer = str(result.get("answer", ""))
    found.answers[name] = answer
    if "nan" in answer.lower().split() or " inf" in answer.lower():
        wrong("no number in the answer", answer)
    if found.case.cannot and _claims(answer):
        wrong("model recommended", f"{found.case.cannot}: {answer}")


def _wrong(found: Outcome, name: str, kind: str, text: str) -> None:
    found.faults.append((kind, f"{name}: {text}"))


def _no_number(text: str) -> None:
    raise ValueError(f"found {text}")


def _claims(answer: str) -> bool:
    return answer.startswith(("Use the", "The fitted model explains")) or "100.0 %" in answer


def measure(cases: int, seed: int, limit_s: float, outcomes: list[Outcome]) -> Iterator[Figure]:
    """Yield what all cases gave together; `outcomes` gets each of them."""
    load_all()
    for k in range(seed, seed + cases):
        found = outcome(k, limit_s)
        outcomes.append(found)
        for kind, text in found.faults:
            sys.stderr.write(f"{found.case.text}\n    {kind}: {text}\n")
    count = Counter(kind for o in outcomes for kind in {kind for kind, _ in o.faults})
    yield Figure("cases", cases, "", "data sets")
    yield Figure("answered", sum(bool(o.answers) for o in outcomes), "", "with a result")
    for kind in (
        "traceback", "warning of a library", "no report", "not JSON", "no number in the answer",
        "refusal without a remedy", "model recommended",
    ):  # fmt: skip
        yield Figure(kind.replace(" ", "_"), count[kind], "", kind, None, NONE)
    yield Figure("too_slow", count["too slow"], "", f"not done after {limit_s:g} s")
    yield Figure("slowest_s", max(o.seconds for o in outcomes), "s", "slowest case")


def _by_fault(outcomes: list[Outcome]) -> Iterator[Table]:
    """Yield a table of what each fault of the data gave."""
    table = Table(title="By fault of the data", title_justify="left")
    for name in ("fault", "cases", "import refused", "identified", "with model", "traced", "wrong"):
        table.add_column(name)
    ordered = sorted(outcomes, key=lambda o: o.case.fault)
    for fault, group in groupby(ordered, key=lambda o: o.case.fault):
        some = list(group)
        imports = sum(any(k.startswith("import") for k in o.refused) for o in some)
        done = [
            sum(name in o.answers for o in some) for name in ("identify", "identify-model", "trace")
        ]
        table.add_row(
            fault, *map(str, (len(some), imports, *done, sum(bool(o.faults) for o in some)))
        )
    yield table


def run() -> None:
    """Parse the command line, run the cases and print both tables."""
    found = parser("Data of all kinds through import, identify and trace")
    found.add_argument("--seed", type=int, default=0, help="seed of the first case")
    found.add_argument("--cases", type=int, help=f"number of cases (default: {CASES})")
    found.add_argument("--limit-s", type=float, default=LIMIT_S, help="time of a case")
    arguments = found.parse_args()
    cases = arguments.cases or (QUICK if arguments.quick else CASES)
    outcomes: list[Outcome] = []
    show(
        "Any data",
        arguments,
        lambda: measure(cases, arguments.seed, arguments.limit_s, outcomes),
        lambda: _by_fault(outcomes),
    )


if __name__ == "__main__":
    run()
