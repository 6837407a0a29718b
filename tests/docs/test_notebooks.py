"""Run the notebooks of the documentation from top to bottom."""

from __future__ import annotations

from pathlib import Path

import pytest
from repository_folders import DOCS

nbclient = pytest.importorskip("nbclient", reason="levid[notebook] is not installed")
import nbformat  # noqa: E402 - comes with nbclient

# They take one to two minutes; a machine that does other things as well takes longer.
_CELL_TIMEOUT_S = 600
RESULTS = {
    "identify": ("m_p = 5.", "<b>Identification of short</b>", "<Plant by subspace: "),
    "trace": ("<b>Trace of small, large</b>: found: Coulomb friction at x", "friction at x"),
    "own_effect": ("<b>Trace of pad</b>: found: Cubic stiffness at z", "simulated: 6e8 N/m^3"),
}


@pytest.mark.parametrize("name", RESULTS)
def test_notebook_runs_and_finds_what_it_says(name: str, tmp_path: Path) -> None:
    book = nbformat.read(DOCS / "notebooks" / f"{name}.ipynb", as_version=4)
    client = nbclient.NotebookClient(
        book,
        timeout=_CELL_TIMEOUT_S,
        kernel_name="python3",
        resources={"metadata": {"path": str(tmp_path)}},
    )
    client.execute()
    outputs = [output for cell in book.cells for output in cell.get("outputs", [])]
    shown = "".join(
        output.get("text", "") + str(output.get("data", {}).get("text/html", ""))
        for output in outputs
    )
    for text in RESULTS[name]:
        assert text in shown
    # Every figure is shown, although no notebook imports pyplot.
    plots = sum(cell.source.rsplit("\n", 1)[-1].count(".plot(") for cell in book.cells)
    figures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert len(figures) == plots > 0
    assert not [output for output in outputs if output.get("name") == "stderr"]
