"""The notebooks in examples/: stored without what they print, and run from their cells as plain Python."""

import contextlib
import io
import json
import warnings
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "examples").glob("*.ipynb"))


def cells(notebook: Path, kind: str) -> list[dict]:
    """Cells of a kind."""
    return [cell for cell in json.loads(notebook.read_text("utf-8"))["cells"] if cell["cell_type"] == kind]


def test_there_are_five() -> None:
    assert [notebook.stem for notebook in NOTEBOOKS] == [
        "calibration_file",
        "compare_estimators",
        "failure_diagnosis",
        "own_matches",
        "sweep",
    ]


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_stored_clean(notebook: Path) -> None:
    table = json.loads(notebook.read_text("utf-8"))
    assert (table["nbformat"], table["nbformat_minor"]) == (4, 5)
    assert len({cell["id"] for cell in table["cells"]}) == len(table["cells"])
    for cell in cells(notebook, "code"):
        assert cell["outputs"] == [] and cell["execution_count"] is None, "clear all outputs before you save it"


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(notebook: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cell after cell in one namespace, as a kernel does; magic commands of notebooks would fail here."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr(plt, "show", lambda: plt.close("all"))
    plt.switch_backend("agg")
    names: dict[str, object] = {"__name__": notebook.stem}
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("error")
        for number, cell in enumerate(cells(notebook, "code")):
            exec(compile("".join(cell["source"]), f"{notebook.name}, code cell {number}", "exec"), names)
