"""Read files with absurd lengths in a process of little memory: started by test_file_lengths_fuzz.

Arguments: folder, number of files a format, seed. Prints a JSON object: failures by format, the
number of files, and the peak memory over that at the start, in bytes.
"""

from __future__ import annotations

import io
import json
import resource
import signal
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import scipy.io

from levid.config.base import ConfigError
from levid.config.files.reading import JsonError, read_json
from levid.config.load_any_kind import load_any
from levid.config.shipped import shipped
from levid.log.catalogue.run_summary import summarise_run
from levid.log.errors import LogError
from levid.log.importing.array_variables import load_npz, read_variables
from levid.log.importing.delimited_text import read_delimited
from levid.log.importing.draft_signals import draft_signals
from levid.log.importing.signals_yaml import SignalsFile
from levid.log.log_summary import summarise_log
from levid.log.reader import read_log
from levid.log.salvage import salvage
from levid.log.signals import cycle_dtype
from levid.log.writer import LogWriter

MOST_BYTES = 1 << 30
"""Address space beyond what is imported: arrays of 2^31 bytes and more cannot be allocated."""
MOST_S = 60
"""Time of one file, far more than it takes on a busy machine."""
_LENGTHS = [
    *(2**k for k in (16, 24, 31, 32, 40, 60, 63)),
    *(2**k - 1 for k in (16, 31, 32, 63, 64)),
]
_TEXT = [b"1" * 5000, b"9e999", b"(" * 5000, b"[" * 5000, b"," * 70_000, b'"' * 3, b"\0" * 9]
_SIGNALS = SignalsFile.model_validate(
    {
        "levid": "signals",
        "rate_hz": 100,
        "columns": [{"column": n, "name": n, "unit": "V", "role": "other"} for n in "ab"],
    }
)


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """Return a file with one to three changes: a length, a text, a cut, a repeated part."""
    found = bytearray(data)
    for _ in range(rng.integers(1, 4)):
        # Lengths stand in the head of a file and in its end.
        span = len(found) if rng.random() < 0.3 else min(len(found), 600)
        at = int(rng.integers(0, max(span, 1)))
        at = at if rng.random() < 0.7 else max(len(found) - 1 - at, 0)
        match rng.integers(0, 6):
            case 0 | 1 | 2:
                size = int(rng.choice([2, 4, 8]))
                length = int(_LENGTHS[rng.integers(0, len(_LENGTHS))]) % 256**size
                found[at : at + size] = length.to_bytes(size, "little")
            case 3:
                found[at:at] = _TEXT[rng.integers(0, len(_TEXT))]
            case 4:
                del found[at:]
            case _:
                found[at:at] = found[at : at + 200] * int(rng.integers(1, 20))
    return bytes(found)


def _read_arrays(path: Path) -> None:
    read_variables(path, _SIGNALS, load_npz(path))


def _read_text(path: Path) -> None:
    read_delimited(path, _SIGNALS, whitespace=False)


def _read_rig(path: Path) -> None:
    load_any(path, {"signals": SignalsFile})


def _summarise(path: Path) -> None:
    assert summarise_run("x", [path]).logs == 1


def _log(path: Path) -> bytes:
    dtype = cycle_dtype(3, 3)
    rows = np.zeros(200, dtype)
    rows["cycle"] = np.arange(200)
    attachments = {"rig.yaml": b"name: a\n", "versions.json": b'{"levid": "1"}'}
    with LogWriter(
        path, dtype, rate_hz=1e3, chunk_s=0.05, metadata={}, attachments=attachments
    ) as log:
        log.write(rows, np.arange(200, dtype=np.uint64))
    return path.read_bytes()


def _saved(save: Callable[[io.BytesIO], object]) -> bytes:
    file = io.BytesIO()
    save(file)
    return file.getvalue()


def _cases(folder: Path) -> list[tuple[str, bytes, list[Callable[[Path], object]]]]:
    values = np.random.default_rng(1).normal(size=(2, 60))
    both = dict(zip("ab", values, strict=True))
    table = "a,b\n" + "".join(f"{a:.6g},{b:.6g}\n" for a, b in values.T)
    rig = shipped("rigs/loopback.yaml").read_bytes()
    log_readers = [read_log, salvage, summarise_log, _summarise]
    return [
        (".mcap", _log(folder / "right.mcap"), log_readers),
        (".npz", _saved(lambda f: np.savez(f, **both)), [_read_arrays, draft_signals]),
        (".npz", _saved(lambda f: np.savez_compressed(f, **both)), [_read_arrays]),
        (".npy", _saved(lambda f: np.save(f, values)), [_read_arrays, draft_signals]),
        (".csv", table.encode(), [_read_text, draft_signals]),
        (".csv", table.encode("utf-16"), [_read_text, draft_signals]),
        (".yaml", rig, [_read_rig]),
        (
            ".json",
            b'{"command": "trace", "x": [{"name": "a", "y": [1.5, null]}]}',
            [read_json],
        ),
    ]


def mat_file() -> bytes:
    """Return a MAT file, whose reader has a process of its own in the product."""
    return _saved(lambda f: scipy.io.savemat(f, {"a": np.arange(60.0), "b": np.arange(60.0)}))


def main(folder: Path, count: int, seed: int) -> None:
    warnings.simplefilter("ignore")
    rng = np.random.default_rng(seed)
    cases = _cases(folder)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (used + MOST_BYTES, hard))
    begin = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    failures, files = [], 0
    for number, (suffix, data, readers) in enumerate(cases):
        for example in range(count):
            path = folder / f"changed{suffix}"
            path.write_bytes(mutated(data, rng))
            for reader in readers:
                signal.alarm(MOST_S)  # it ends this process: the parent says so
                try:
                    reader(path)
                except (LogError, ConfigError, JsonError):
                    pass
                except BaseException as error:  # noqa: BLE001 - each is a finding
                    kept = folder / f"failed-{number}-{example}{suffix}"
                    kept.write_bytes(path.read_bytes())
                    failures.append(f"{reader.__name__}({kept}): {error!r}"[:500])
                files += 1
    signal.alarm(0)
    peak = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - begin)
    sys.stdout.write(json.dumps({"failures": failures, "files": files, "bytes": peak}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
