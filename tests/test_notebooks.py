"""The notebooks: their code runs, here with small settings, and what is committed of their outputs is small and no error."""

from __future__ import annotations

import base64
import importlib.util
import json
import re
from pathlib import Path
from types import ModuleType

import matplotlib.pyplot as plt
import pytest

DOCS = Path(__file__).resolve().parent.parent / "docs"
NOTEBOOK = DOCS / "notebooks" / "first_federation.ipynb"
#: In place of the notebook's first code cell.
SMALL = """PROGRESS = True
BANDIT_ROUNDS, BANDIT_PRETRAINING = 2, {"bc_batch_size": 32, "bc_updates": 2, "dice_updates": 2, "dataset_size": 100}
REACHER_ROUNDS, REACHER_STEPS = 2, 200"""


def cells(kind: str) -> list[dict]:
    return [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == kind]


def small_code() -> list[str]:
    settings, *rest = ["".join(cell["source"]) for cell in cells("code")]
    names = [{line.partition(" =")[0] for line in text.splitlines()} for text in (settings, SMALL)]
    assert names[0] == names[1]
    return [SMALL, *rest]


@pytest.fixture(scope="module")
def notebook_pages() -> ModuleType:
    spec = importlib.util.spec_from_file_location("notebook_pages", DOCS / "notebook_pages.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.filterwarnings("ignore:FigureCanvasAgg is non-interactive")
def test_the_code_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    plt.switch_backend("agg")
    names: dict = {"__name__": "notebook"}
    try:
        for code in small_code():
            exec(compile(code, str(NOTEBOOK), "exec"), names)
        assert len(plt.get_fignums()) == 2
    finally:
        plt.close("all")
    assert set(names["policies"]) == {"FedAvg", "FedGuide"} and set(names["last"]) == {"Local", "FedAvg"}


@pytest.mark.slow
def test_a_kernel_executes_it(tmp_path: Path) -> None:
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    notebook = nbformat.read(NOTEBOOK, 4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    for cell, source in zip(code, small_code(), strict=True):
        cell.source = source
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in code for output in cell.outputs]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2


def test_what_is_committed_is_a_whole_execution_with_small_pictures() -> None:
    code = cells("code")
    counts, outputs = [cell["execution_count"] for cell in code], [output for cell in code for output in cell["outputs"]]
    assert counts == list(range(1, len(code) + 1))
    pictures = [output["data"]["image/png"] for output in outputs if "data" in output]
    assert len(pictures) == 2 and sum(len(base64.b64decode(picture)) for picture in pictures) < 200_000
    assert all(output["output_type"] in ("stream", "display_data") for output in outputs)
    assert "/root" not in NOTEBOOK.read_text() and NOTEBOOK.stat().st_size < 300_000


def test_the_site_shows_text_code_outputs_and_pictures(notebook_pages: ModuleType, tmp_path: Path) -> None:
    page = notebook_pages.page(NOTEBOOK)["first_federation.md"].decode()
    assert page.startswith("# ") and "first_federation.ipynb" in page and page.count("```python\n") == len(cells("code"))
    notebook, file = json.loads(NOTEBOOK.read_text()), tmp_path / "changed.ipynb"
    cell = notebook["cells"][1]
    picture = {"output_type": "display_data", "data": {"image/png": base64.b64encode(b"picture").decode()}, "metadata": {}}
    cell["outputs"] = [{"output_type": "stream", "name": "stdout", "text": ["a line\n"]}, picture]
    file.write_text(json.dumps(notebook))
    files = notebook_pages.page(file)
    assert files["changed_1.png"] == b"picture"
    assert "```text\na line\n```\n\n![What the code above draws](changed_1.png)\n" in files["changed.md"].decode()
    cell["outputs"] = [{"output_type": "error", "ename": "ValueError", "evalue": "", "traceback": []}]
    file.write_text(json.dumps(notebook))
    with pytest.raises(ValueError, match="output of the kind error"):
        notebook_pages.page(file)


def test_links_lead_to_pages() -> None:
    targets = [target for cell in cells("markdown") for target in re.findall(r"\]\(([^)#]+)", "".join(cell["source"]))]
    assert targets and all((NOTEBOOK.parent / target).is_file() for target in targets)
