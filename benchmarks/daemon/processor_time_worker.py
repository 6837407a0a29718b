"""Run cases of `processor_time_vs_commit.py` with the code on PYTHONPATH; print their times.

The benchmarks of one version are in the folder given as argument, under today's names or under
those that they had up to commit da9bfb8.
"""

from __future__ import annotations

import importlib.util
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np

CYCLES = 20_000
ROWS = 100_000


def main() -> None:
    folder = Path(sys.argv[1])
    loop = _load(folder, "daemon/virtual_time_speed.py", "loop.py")
    log = _load(folder, "log/log_read_write_speed.py", "log/read_write.py", "log.py")
    loop.perf_counter = time.process_time  # type: ignore[attr-defined]
    rows = log.flight(ROWS)
    times = (rows["time_s"] * 1e9).astype(np.uint64)
    with tempfile.TemporaryDirectory() as logs:
        fast, slow, new = (Path(logs) / f"{name}.mcap" for name in ("10khz", "1khz", "new"))
        log._write_levid(fast, rows, times)
        log._write_levid(slow, rows, times, rate_hz=1000)
        cases: dict[str, Callable[[], float]] = {
            "loop_1khz": lambda: CYCLES / loop.levid_rate(1000.0, CYCLES // 2),
            "loop_10khz": lambda: CYCLES / loop.levid_rate(10_000.0, CYCLES),
            "log_write": lambda: _cost_s(lambda: log._write_levid(new, rows, times)),
            "log_read": lambda: _cost_s(lambda: log.read_log(fast)),
            "log_read_1khz": lambda: _cost_s(lambda: log.read_log(slow)),
        }
        for line in sys.stdin:
            new.unlink(missing_ok=True)  # a log is never written over another
            print(cases[line.strip()](), flush=True)


def _cost_s(run: Callable[[], object]) -> float:
    """Return the processor time in s of this process and its threads."""
    start = time.process_time()
    run()
    return time.process_time() - start


def _load(folder: Path, *names: str) -> ModuleType:
    """Import the first of these files that exists."""
    path = next(folder / name for name in names if (folder / name).exists())
    sys.path.insert(0, str(path.parent))
    spec = importlib.util.spec_from_file_location(path.stem + "_benchmark", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


if __name__ == "__main__":
    main()
