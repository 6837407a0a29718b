"""Make a command independent of its environment: variables, search path, working directory.

Each line here is a variable with which a command failed after a flight, or ran code that the user
did not name.
"""

from __future__ import annotations

import os
import sys
import sysconfig
import warnings
from pathlib import Path

from .import_guard import OwnProcess
from .private_files import make_private_folder
from .user_folders import absolute_folder, home, temporary_folder

_DROPPED = (
    *("MATPLOTLIBRC", "SOURCE_DATE_EPOCH", "TEXTUAL_DRIVER"),
    *("PYTHONWARNINGS", "PYTHONINSPECT", "PYTHONBREAKPOINT"),
)
_PACKAGES = (
    *("CANTOOLS_", "LLVMLITE_", "MPL", "MSGPACK_", "NPY_", "NUMBA_", "NUMPY_", "PROMETHEUS_"),
    *("PYDANTIC_", "SCIPY_", "prometheus_"),
)
"""Prefixes of the settings of packages, which change results or print, or name folders of code."""
_KEPT = "NUMBA_CACHE_DIR"
_XDG = "XDG_"
_SIZES = ("COLUMNS", "LINES")
_LARGEST_SIZE = 1000
_NO_HOME = "/nonexistent"
"""Home folder of users without one, as on Debian."""


def prepare_command() -> None:
    """Prepare this process and its children for a command of levid; safe to call twice."""
    if OwnProcess.value:
        return
    OwnProcess.value = True
    _forget_working_directory()
    for name in list(os.environ):
        # The specification of XDG says to ignore a relative path.
        names_folder = name.startswith(_XDG) and name.endswith(("_HOME", "_DIR"))
        relative = names_folder and absolute_folder(os.environ[name]) is None
        of_package = name.startswith(_PACKAGES) and name != _KEPT
        if name in _DROPPED or of_package or relative:
            del os.environ[name]
    for name in _SIZES:
        value = os.environ.get(name, "1")
        if not (value.isdecimal() and value.isascii() and 0 < int(value) <= _LARGEST_SIZE):
            del os.environ[name]
    _set_home()
    if sys.warnoptions:  # PYTHONWARNINGS=error makes each warning of a package an exception
        sys.warnoptions.clear()
        warnings.resetwarnings()
        for kind in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
            warnings.simplefilter("ignore", kind)


def _forget_working_directory() -> None:
    """Import no module from the working directory; `python -m` and a PYTHONPATH of ':' do so."""
    os.environ["PYTHONSAFEPATH"] = "1"  # for children
    try:
        here = Path.cwd().resolve()
    except OSError:  # it was removed
        here = None
    paths = sysconfig.get_paths()
    installed = {Path(paths[key]).resolve() for key in ("stdlib", "platlib", "purelib")}
    kept = []
    for entry in sys.path:
        path = absolute_folder(entry)
        if path is not None and (path.resolve() != here or path.resolve() in installed):
            kept.append(entry)
    sys.path[:] = kept


def _set_home() -> None:
    """Set HOME to an absolute path, so that no package looks for `~` in the working directory."""
    found = home()
    if found is None:
        folder = temporary_folder()
        found_name = str(folder) if make_private_folder(folder) else _NO_HOME
    else:
        found_name = str(found)
    os.environ["HOME"] = found_name
