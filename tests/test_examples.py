"""Every example runs, in this process. Of the notebooks the code cells: Jupyter is not needed for that."""

import json
import runpy
import warnings
from pathlib import Path

import matplotlib
import pytest

EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.fixture(autouse=True)
def _plain(monkeypatch, tmp_path):
    """As a fresh process would be: in a folder of its own, filters and figures left as they were."""
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    with warnings.catch_warnings():
        yield
    from matplotlib import pyplot

    pyplot.close("all")


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_script(path, capsys):
    runpy.run_path(str(path), run_name="__main__")
    printed = capsys.readouterr().out
    assert len(printed.splitlines()) >= 3
    assert "nan" not in printed
    lines = path.read_text().splitlines()
    assert len(lines) <= 61
    assert lines[0].startswith('"""')


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.ipynb")), ids=lambda path: path.stem)
def test_notebook(path, capsys):
    notebook = json.loads(path.read_text())
    scope = {"__name__": "__main__"}
    for number, cell in enumerate(notebook["cells"]):
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            exec(compile("".join(cell["source"]), f"{path.name}, cell {number}", "exec"), scope)
    assert "nan" not in capsys.readouterr().out
    assert notebook["nbformat"] == 4


def test_there_are_enough():
    assert len(list(EXAMPLES.glob("*.py"))) >= 6
    assert len(list(EXAMPLES.glob("*.ipynb"))) >= 2
