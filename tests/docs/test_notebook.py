"""The notebook of the documents runs again, with the outputs that it stores."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).resolve().parents[2] / "docs/notebook.ipynb"


def outputs(notebook: Any) -> list[set[str]]:
    """Kinds of output of each cell, without streams."""
    found = [cell.get("outputs", ()) for cell in notebook.cells]
    assert all(output.output_type != "error" for each in found for output in each)
    return [{kind for output in each for kind in output.get("data", ())} for each in found]


def test_the_notebook_is_small_and_stores_its_outputs() -> None:
    assert NOTEBOOK.stat().st_size < 300 * 1024
    stored = outputs(nbformat.read(NOTEBOOK, as_version=4))
    assert sum("image/png" in kinds for kinds in stored) == 4


# With the laboratory made, the code that both need is compiled, and not by two processes at once.
@pytest.mark.long
@pytest.mark.usefixtures("laboratory")
def test_the_notebook_runs_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.delenv("MPLBACKEND", raising=False)
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    stored = outputs(notebook)
    client = NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}})
    client.execute()
    assert outputs(notebook) == stored
