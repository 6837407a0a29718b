"""Test the check of output folders."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from levid.cli.output_folder_check import (
    claimed_folder,
    older_results,
    writable_folder,
)
from levid.config.base import ConfigError


def test_folder_that_cannot_be_written_is_rejected_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writable_folder(tmp_path / "new" / "deeper")
    assert not (tmp_path / "new").exists()  # the check creates nothing
    (tmp_path / "report.html").write_text("")
    for out in ("report.html", "report.html/x"):
        with pytest.raises(ConfigError, match=r"report.html.*: expected a folder, found .*file"):
            writable_folder(tmp_path / out)
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write everywhere
    with pytest.raises(ConfigError, match="may not be written to"):
        writable_folder(tmp_path / "new")


def test_paths_that_block_results_are_rejected_before_the_work(tmp_path: Path) -> None:
    for name in ("model.yaml", "figures/x"):
        (tmp_path / "a" / name).mkdir(parents=True)
    writable_folder(tmp_path / "a", ("index.html",), ("figures",))
    with pytest.raises(ConfigError, match=r"to write model.yaml, found a folder of that name"):
        writable_folder(tmp_path / "a", ("model.yaml",))
    (tmp_path / "figures").write_text("")
    with pytest.raises(ConfigError, match="expected figures to be a writable folder"):
        writable_folder(tmp_path, (), ("figures",))
    (tmp_path / "link").symlink_to(tmp_path / "gone")
    with pytest.raises(ConfigError, match="found a link to a missing path"):
        writable_folder(tmp_path / "link")


def test_results_of_an_earlier_run_are_returned(tmp_path: Path) -> None:
    (tmp_path / "model.yaml").write_text("")
    began_s = time.time() + 1.0
    (tmp_path / "identified.mat").write_text("")
    os.utime(tmp_path / "identified.mat", (began_s + 1.0,) * 2)
    names = ("model.yaml", "identified.mat", "multisine.mat")
    assert older_results(tmp_path, names, began_s) == [tmp_path / "model.yaml"]


def test_folder_is_claimed_by_one_process(tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"
    code = (
        "import sys; from pathlib import Path\n"
        "from levid.cli.output_folder_check import claimed_folder\n"
        "with claimed_folder(Path(sys.argv[1])): print('mine', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(out)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as other:
        assert other.stdout is not None
        assert other.stdin is not None
        assert other.stdout.readline() == "mine\n"
        another = pytest.raises(ConfigError, match="another levid command is writing")
        with another, claimed_folder(out):
            pass
        other.stdin.close()
        other.wait()
    assert not (tmp_path / "a").exists()  # what stays empty goes
    with claimed_folder(out):
        (out / "model.yaml").touch()
    assert sorted(p.name for p in out.iterdir()) == ["model.yaml"]


def test_claim_of_a_killed_process_ends_with_it(tmp_path: Path) -> None:
    code = (
        "import os, sys; from pathlib import Path\n"
        "from levid.cli.output_folder_check import claimed_folder\n"
        "with claimed_folder(Path(sys.argv[1])): os.kill(os.getpid(), 9)"
    )
    killed = subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
    assert killed.returncode == -9
    with claimed_folder(tmp_path):
        pass
