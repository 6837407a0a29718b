"""Test that no variable, setting or umask of the user decides whether a result is kept."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from commands_in_one_process import plain_environment, run_commands
from mass_on_spring_logs import imported

SESSION = """
levid: session
name: short
rate_hz: 1000
seed: 3
steps:
  - levitate: {settle_s: 0.2}
  - record: {name: still, duration_s: 1.5}
  - land: {}
"""
USETEX = (
    "text.usetex: True\nfont.family: No Such Font\nbackend: module://nowhere\nfigure.dpi: 1e9\n"
)
READ_ONLY = "/proc/nowhere"  # in which nobody makes a folder, root neither

ENVIRONMENTS = {
    "settings of packages": {
        "MATPLOTLIBRC": "{rc}",
        "MPLBACKEND": "Nonsense",
        "OMP_NUM_THREADS": "some",
        "OPENBLAS_NUM_THREADS": "some",
        "NUMBA_NUM_THREADS": "some",
        "NUMBA_OPT": "9",
        "NUMBA_CPU_NAME": "nonsense",
        "NUMBA_DEBUG": "1",
        "NUMBA_DUMP_IR": "1",
        "NUMBA_DISABLE_JIT": "1",
        "NUMBA_CACHE_LOCATOR_CLASSES": "nowhere.Locator",
        "SCIPY_ARRAY_API": "some",
        "NUMPY_MADVISE_HUGEPAGE": "some",
        "PYDANTIC_DISABLE_PLUGINS": "some",
        "CANTOOLS_CACHE_DIR": "here",
    },
    "nothing writable, settings at home": {
        "HOME": "{home}",
        "XDG_CONFIG_HOME": "{home}/.config",
        "MPLCONFIGDIR": READ_ONLY,
        "XDG_CACHE_HOME": READ_ONLY,
        "TMPDIR": READ_ONLY,
        "MPLBACKEND": "module://nowhere",
        "LC_ALL": "xx_YY.ISO-8859-99",
        "LANGUAGE": "tlh",
    },
    "no home, relative folders, ASCII, warnings are errors": {
        "HOME": None,
        "XDG_CACHE_HOME": "here",
        "XDG_CONFIG_HOME": "here",
        "XDG_RUNTIME_DIR": "here",
        "XDG_STATE_HOME": "here",
        "MPLCONFIGDIR": "here",
        "NUMBA_CACHE_DIR": "here",
        "LC_ALL": "C",
        "PYTHONUTF8": "0",
        "PYTHONCOERCECLOCALE": "0",
        "PYTHONWARNINGS": "error",
        "PYTHONINSPECT": "1",
        "PYTHONPATH": ":",
    },
    "home that is no folder, numbers that are none": {
        "HOME": "/dev/null",
        "PATH": None,
        "TERM": None,
        "COLUMNS": "many",
        "LINES": "-3",
        "TZ": "Nowhere/No_Such_City",
        "SOURCE_DATE_EPOCH": "never",
    },
}


def measured(folder: Path) -> Path:
    """Return a log of an input and its filtered output."""
    force = np.random.default_rng(1).normal(size=2000)
    position = 1e-3 * np.convolve(force, [0, 1, 0.5])[:2000]
    return imported(folder, "mass", np.column_stack((force, position)))


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_results_are_kept_and_drawn(name: str, tmp_path: Path) -> None:
    home, here, data = (tmp_path / folder for folder in ("home", "here", "data"))
    (home / ".config" / "matplotlib").mkdir(parents=True)
    for folder in (here, data):
        folder.mkdir()
    (home / ".config" / "matplotlib" / "matplotlibrc").write_text(USETEX)
    rc = tmp_path / "matplotlibrc"
    rc.write_text(USETEX)
    environment = plain_environment()
    for key, value in ENVIRONMENTS[name].items():
        environment.pop(key, None)
        if value is not None:
            environment[key] = value.format(home=home, rc=rc)
    (data / "session.yaml").write_text(SESSION)
    log = measured(data)
    flown, found = data / "flown", data / "found"
    done = run_commands(
        [
            ["excite", data / "session.yaml", "--virtual", "--out", flown],
            ["identify", log, "--out", found, "--json"],
            ["plot", log, "x_m", "-o", data / "x.svg"],
        ],
        here, environment, tmp_path, umask=0o077,
    )  # fmt: skip
    assert done.codes == [0, 0, 0], done.stderr
    assert "Traceback" not in done.stderr
    assert "Warning" not in done.stderr
    assert len(list(flown.glob("*.mcap"))) == 3
    # One object and the path of the plot: no package prints on the standard output.
    result, plot = done.stdout.splitlines()
    assert json.loads(result)["points"]
    assert plot == str(data / "x.svg")
    for page in (flown / "report", found):
        assert "could not be drawn" not in (page / "index.html").read_text()
    assert "DejaVu Sans" in (data / "x.svg").read_text()
    assert list(here.iterdir()) == []


def test_figures_that_fail_cost_no_result(tmp_path: Path) -> None:
    """A matplotlib whose fonts cannot be read fails at each figure."""
    broken = tmp_path / "broken" / "matplotlib_fails"
    broken.mkdir(parents=True)
    (broken.parent / "sitecustomize.py").write_text(
        "import sys\n"
        "class Finder:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'matplotlib.backends.backend_svg':\n"
        "            raise OSError('no fonts')\n"
        "sys.meta_path.insert(0, Finder())\n"
    )
    log = measured(tmp_path)
    found = tmp_path / "found"
    environment = plain_environment() | {"PYTHONPATH": str(broken.parent)}
    (tmp_path / "session.yaml").write_text(SESSION)
    done = run_commands(
        [
            ["identify", log, "--out", found, "--json"],
            ["excite", tmp_path / "session.yaml", "--virtual", "--out", tmp_path / "flown"],
        ],
        tmp_path, environment, tmp_path,
    )  # fmt: skip
    assert done.codes == [1, 1], done.stderr
    assert json.loads(done.stdout.splitlines()[0])["points"]
    assert json.loads((found / "result.json").read_text())["points"]
    assert "warning: a figure could not be drawn" in done.stderr
    assert "no fonts" in done.stderr
    assert "could not be drawn: OSError: no fonts" in (found / "index.html").read_text()
    assert len(list((tmp_path / "flown").glob("*.mcap"))) == 3
    assert "could not be drawn" in (tmp_path / "flown" / "report" / "index.html").read_text()


def test_results_are_kept_if_matplotlib_cannot_be_imported(tmp_path: Path) -> None:
    broken = tmp_path / "broken" / "matplotlib"
    broken.mkdir(parents=True)
    (broken / "__init__.py").write_text("raise ImportError('libfreetype.so.6: cannot open')\n")
    log = measured(tmp_path)
    environment = plain_environment() | {"PYTHONPATH": str(broken.parent)}
    done = run_commands(
        [["identify", log, "--out", tmp_path / "found"]], tmp_path, environment, tmp_path
    )
    assert done.codes == [1]
    assert "all records: 1 record" in done.stdout
    assert "the results are written, the report is not: ImportError: libfreetype" in done.stderr
    assert json.loads((tmp_path / "found" / "result.json").read_text())["points"]
    assert os.access(tmp_path / "found" / "result.json", os.R_OK)
