"""Folders are reached through links of this user and of root alone."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from levid.config.files.atomic_write import open_new, write_file
from levid.config.files.folders import ForeignLinkError, make_folder, opened_folder

_OTHER = 65534
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can give links away")


def test_folders_are_created_as_far_as_they_are_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    make_folder("a/b/c")
    make_folder(tmp_path / "a" / "b" / ".." / "d")
    make_folder("")
    assert (tmp_path / "a" / "b" / "c").is_dir()
    assert (tmp_path / "a" / "d").is_dir()


def test_links_of_this_user_are_followed(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "relative").symlink_to("disk")
    (tmp_path / "absolute").symlink_to(tmp_path / "relative")
    write_file(tmp_path / "absolute" / "x", "1")
    assert (tmp_path / "disk" / "x").read_text() == "1"


@needs_root
def test_links_of_other_users_are_not_followed(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.mkdir()
    link = tmp_path / "figures"
    link.symlink_to(precious)
    os.chown(link, _OTHER, _OTHER, follow_symlinks=False)
    for action in (
        lambda: write_file(link / "x", "1"),
        lambda: open_new(link / "x"),
        lambda: make_folder(link / "new" / "deep"),
        lambda: make_folder(link),
    ):
        with pytest.raises(ForeignLinkError, match="made: links of other users") as error:
            action()
        assert str(link) in str(error.value.filename)
    assert list(precious.iterdir()) == []


def test_folder_that_is_exchanged_for_a_link_meanwhile_gets_the_file(tmp_path: Path) -> None:
    out, precious = tmp_path / "out", tmp_path / "precious"
    out.mkdir()
    precious.mkdir()
    with opened_folder(out) as folder:
        out.rename(tmp_path / "moved")
        out.symlink_to(precious)
        os.close(os.open("x", os.O_WRONLY | os.O_CREAT, dir_fd=folder))
    assert (tmp_path / "moved" / "x").exists()
    assert list(precious.iterdir()) == []


def test_endless_links_and_files_are_no_folders(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "a", tmp_path / "file", tmp_path / "file" / "x", tmp_path / "none"):
        with pytest.raises(OSError) as error, opened_folder(path):  # noqa: PT011 - file below
            pass
        assert error.value.filename == str(path)
