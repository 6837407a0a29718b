"""Fixtures for tests of imported data."""

from __future__ import annotations

import io

import pytest

from levid.log.importing import mat_file_reader


@pytest.fixture
def mat_in_this_process(monkeypatch):
    """Read MAT files without a child process, whose start takes longer than all else."""

    def answer(path, request):
        out = io.BytesIO()
        mat_file_reader._answer(path, request, out)
        return out.getvalue()

    monkeypatch.setattr(mat_file_reader, "_child", answer)
