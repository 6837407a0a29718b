"""Test that no file of the working directory decides what code runs.

Each command runs in a folder full of files that Python, levid's packages and their configuration
readers look for by name. An audit hook in the command and in all processes that it starts reports
every file that is opened there, and every folder that is searched.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from commands_in_one_process import plain_environment, run_commands
from daemon_process import calm
from live_view import RIG_FILE
from mass_on_spring_logs import MASS, imported, moved

from levid.config.rig import load_rig
from levid.config.runtime.compile_cache import cache_folder
from levid.config.shipped import shipped

AUDIT = """
import os, sys
_log = os.open(os.environ["LEVID_TEST_AUDIT"], os.O_WRONLY | os.O_APPEND | os.O_CREAT)
_forbidden = os.environ["LEVID_TEST_FORBIDDEN"]
_events = {"open", "os.listdir", "os.scandir", "os.chdir", "ctypes.dlopen"}
def _hook(event, arguments, join=os.path.join, getcwd=os.getcwd, fsdecode=os.fsdecode):
    if event not in _events or not arguments or not isinstance(arguments[0], (str, bytes)):
        return
    name = fsdecode(arguments[0])
    # The event does not say relative to which folder: the writer of files opens folders part by
    # part, and new files in them. Neither reads anything.
    if event == "open" and (arguments[2] or 0) & (os.O_DIRECTORY | os.O_EXCL | os.O_PATH):
        return
    try:
        here = getcwd()
    except OSError:
        return
    path = name if name.startswith("/") else join(here, name)
    if event == "ctypes.dlopen" and "/" not in name:
        return
    if path.rstrip("/.") == _forbidden or path.startswith(_forbidden + "/"):
        os.write(_log, f"{event} {path} {' '.join(sys.orig_argv[1:4])!r}\\n".encode())
sys.addaudithook(_hook)
"""
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
NO_ACCOUNT = """
import pwd
def _unknown(uid):
    raise KeyError(f"getpwuid(): uid not found: {uid}")
pwd.getpwuid = _unknown
"""
CONFIGURATION = {
    ".numba_config.yaml": "cache_dir: here\ndebug: 1\n",
    "matplotlibrc": "backend: module://sitecustomize\n",
    "can.conf": "[default]\ninterface = nowhere\n",
    "can.ini": "[default]\ninterface = nowhere\n",
    ".can": "[default]\ninterface = nowhere\n",
    ".canrc": "[default]\ninterface = nowhere\n",
    "dask.yaml": "distributed: 1\n",
    "distributed.yaml": "distributed: 1\n",
    ".coveragerc": "[run]\n",
    "pyproject.toml": "[tool.levid]\n",
    "setup.cfg": "[levid]\n",
    "pyvenv.cfg": "home = /nowhere\n",
    "python311._pth": "here\n",
    "evil.pth": "import sitecustomize\n",
    "levid.yaml": "x\n",
    ".env": "PYTHONPATH=here\n",
    "site.cfg": "[openblas]\n",
    "openssl.cnf": "x\n",
    "libopenblas.so": "x\n",
    ".dockerenv": "x\n",
    "inputrc": "x\n",
}
"""Files that these packages or their relatives read from some folder, and their content."""


@pytest.fixture
def trap(tmp_path: Path) -> Path:
    """Return a folder of decoys: configuration, and a module by each name that is ever imported."""
    folder = tmp_path / "trap"
    folder.mkdir()
    for name, text in CONFIGURATION.items():
        (folder / name).write_text(text)
    modules = {*sys.stdlib_module_names, *packages_distributions(), "usercustomize"}
    for name in modules:
        if name.isidentifier():
            (folder / f"{name}.py").write_text(f"raise SystemExit('imported {name}')\n")
    (folder / "~" / ".cache").mkdir(parents=True)  # where an unset HOME leads
    evil = folder / "evil-1.0.dist-info"
    evil.mkdir()
    (evil / "METADATA").write_text("Metadata-Version: 2.1\nName: evil\nVersion: 1.0\n")
    (evil / "entry_points.txt").write_text("[levid.backends]\nevil = sitecustomize:X\n")
    return folder


def audited(tmp_path: Path, trap: Path) -> tuple[dict[str, str], Path]:
    """Return an environment in which processes of Python report, and the file of their reports."""
    hook, report = tmp_path / "hook", tmp_path / "audit.txt"
    hook.mkdir()
    (hook / "sitecustomize.py").write_text(AUDIT)
    report.touch()
    added = {"LEVID_TEST_AUDIT": str(report), "LEVID_TEST_FORBIDDEN": str(trap)}
    before = os.environ.get("PYTHONPATH")
    path = os.pathsep.join(filter(None, (str(hook), before)))
    return plain_environment() | added | {"PYTHONPATH": path}, report


def test_hook_reports_what_is_opened_and_searched(tmp_path: Path, trap: Path) -> None:
    environment, report = audited(tmp_path, trap)
    for code in ("open('can.conf')", "import no_such_module"):
        subprocess.run(
            [sys.executable, "-c", code],
            cwd=trap,
            env=environment,
            check=False,
            capture_output=True,
        )
    text = report.read_text()
    assert f"open {trap}/can.conf" in text
    assert f"os.listdir {trap}" in text


def test_commands_look_at_nothing_in_the_working_directory(tmp_path: Path, trap: Path) -> None:
    data = tmp_path / "data"
    data.mkdir()
    model, csv = data / "model.yaml", data / "mass.csv"
    model.write_text(MASS.model_dump_json())
    (data / "session.yaml").write_text(SESSION)
    log = imported(data, "mass", moved(2000))
    found, flown = data / "found", data / "flown"
    environment, report = audited(tmp_path, trap)
    done = run_commands(
        [
            ["check", RIG_FILE],
            ["excite", data / "session.yaml", "--virtual", "--out", flown],
            ["identify", log, "--model", model, "--out", found],
            ["trace", log, "--model", model, "--out", data / "traced", "--workers", "2"],
            ["compare", found, found],
            ["plot", log, "-o", data / "x.svg"],
            ["export", log, "-o", data / "x.csv"],
            ["import", csv, "--signals", data / "signals.yaml", "-o", data / "b.mcap"],
            ["info", log, found],
            ["list", data],
            ["salvage", log, "--out", data / "salvaged"],
            ["layout", RIG_FILE, "--out", data / "layouts"],
            ["completion", "bash"],
            ["status"],
            ["--help"],
        ],
        trap, environment, tmp_path,
    )  # fmt: skip
    assert report.read_text() == ""
    # No daemon runs that `status` could ask; all other commands do all of their work.
    assert done.codes == [*[0] * 13, 1, 0], done.stderr


def test_daemon_looks_at_nothing_in_the_working_directory(tmp_path: Path, trap: Path) -> None:
    """Nor does it fail for a user without home folder and account, as in a container."""
    sim = str(shipped("sims/nominal.yaml"))
    rig = calm(load_rig(RIG_FILE), tmp_path, socket=str(tmp_path / "levid.sock"), sim=sim)
    file = tmp_path / "rig.yaml"
    file.write_text(rig.model_dump_json())
    environment, report = audited(tmp_path, trap)
    with (tmp_path / "hook" / "sitecustomize.py").open("a") as hook:
        hook.write(NO_ACCOUNT)
    folder = cache_folder()
    if folder is not None:  # compiling takes a minute
        environment["NUMBA_CACHE_DIR"] = str(folder.parents[1])
    del environment["HOME"]
    script = tmp_path / "run.py"
    script.write_text("import sys\nfrom levid.cli.entry import main\nmain()\n")
    with subprocess.Popen(
        [sys.executable, str(script), "run", str(file)],
        cwd=trap, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    ) as daemon:  # fmt: skip
        assert daemon.stdout is not None
        said = []
        for line in daemon.stdout:
            said.append(line)
            if "Ctrl-C lands" in line:
                daemon.send_signal(signal.SIGINT)
        daemon.wait()
    assert any("Ctrl-C lands" in line for line in said), said
    assert report.read_text() == ""
