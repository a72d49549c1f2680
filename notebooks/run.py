"""Run notebooks in their kernels and store what they show: ``python notebooks/run.py [NAME …]``.

It needs the extra ``notebooks``. Pictures are stored as PNG or JPEG, whichever is smaller. Times
and counts of executions are left out, so that a notebook changes only where its outputs do.
"""

from __future__ import annotations

import base64
import io
import os
import sys
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from PIL import Image

HERE = Path(__file__).parent
QUALITY = 90
"""Of JPEG, in percent."""


def run(path: Path) -> None:
    """Execute one notebook and write it back with its outputs."""
    began = time.monotonic()
    notebook = nbformat.read(path, as_version=4)
    print(f"{path.name}: running …", flush=True)
    os.environ["PYTHONPATH"] = str(HERE.parent)
    NotebookClient(notebook, timeout=1200, kernel_name="python3").execute(cwd=str(HERE))
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.execution_count = None
            cell.metadata.pop("execution", None)
            cell.outputs = [tidy(output) for output in cell.outputs if shows(output)]
    notebook.metadata["language_info"] = {"name": "python"}
    nbformat.write(notebook, path)
    size, took = path.stat().st_size / 1000, time.monotonic() - began
    print(f"{path.name}: {size:.0f} kB, {took:.0f} s", flush=True)


def shows(output) -> bool:
    """Tell whether an output is for readers; logs and warnings are not."""
    return not (output.output_type == "stream" and output.name == "stderr")


def tidy(output):
    """Return an output with one picture, the smaller of PNG and JPEG, and no count."""
    if "execution_count" in output:
        output["execution_count"] = None
    png = output.get("data", {}).get("image/png")
    if png is None:
        return output
    image = Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB")
    made = {}
    for kind, options in (("png", {"optimize": True}), ("jpeg", {"quality": QUALITY})):
        buffer = io.BytesIO()
        image.save(buffer, kind, **options)
        made[f"image/{kind}"] = buffer.getvalue()
    kind = min(made, key=lambda name: len(made[name]))
    output["data"] = {kind: base64.b64encode(made[kind]).decode()}
    return output


if __name__ == "__main__":
    chosen = [HERE / name for name in sys.argv[1:]] or sorted(HERE.glob("*.ipynb"))
    for one in chosen:
        run(one)
