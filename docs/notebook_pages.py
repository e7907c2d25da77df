"""Notebooks as pages of the site: their text, code and outputs as Markdown, and their pictures as files beside it.

What is committed with a notebook is shown; nothing is executed here (``make notebook`` does).
"""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

NOTEBOOKS = Path(__file__).parent / "notebooks"


def page(notebook: Path) -> dict[str, bytes]:
    """File name to content of what the site needs of a notebook.

    :raises ValueError: for an output of a kind that is not shown, an error for example
    """
    parts, files = [], {}
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            if text := _text(output):
                parts.append(f"```text\n{text.rstrip()}\n```")
            elif picture := output.get("data", {}).get("image/png"):
                name = f"{notebook.stem}_{len(files) + 1}.png"
                files[name] = base64.b64decode(picture)
                parts.append(f"![What the code above draws]({name})")
            else:
                raise ValueError(f"{notebook.name}: an output of the kind {output['output_type']} cannot be shown")
    title, *rest = parts
    head = f"{title}\n\n{{download}}`This page as a notebook <{notebook.name}>`"
    return {f"{notebook.stem}.md": "\n\n".join([head, *rest, ""]).encode(), **files}


def _text(output: dict[str, Any]) -> str:
    """What was printed."""
    return "".join(output["text"]) if output["output_type"] == "stream" and output["name"] == "stdout" else ""


def write_pages(folder: Path = NOTEBOOKS) -> None:
    """Write the pages whose content has changed."""
    for notebook in sorted(folder.glob("*.ipynb")):
        for name, content in page(notebook).items():
            file = folder / name
            if not file.exists() or file.read_bytes() != content:
                file.write_bytes(content)
