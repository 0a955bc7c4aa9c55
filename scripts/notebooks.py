"""Run the notebooks of the documentation in place.

    python scripts/notebooks.py [docs/notebooks/first_flight.ipynb ...]

Needs ``pip install '.[docs]'``. The output depends only on the cells and the versions: it has no times and no machine
names. tests/docs/test_notebooks.py runs the same cells without Jupyter.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def execute(path: Path) -> None:
    """Run all cells of a notebook in order and store their output in it."""
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        client = NotebookClient(notebook, timeout=600, record_timing=False, resources={"metadata": {"path": folder}})
        client.execute()
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    for number, cell in enumerate(notebook.cells):
        cell.id, cell.metadata = f"cell-{number}", {}
        for output in cell.get("outputs", []):
            output.pop("metadata", None)
            if output.output_type in ("display_data", "execute_result"):
                output.metadata = {}
                output.data = {k: v for k, v in output.data.items() if k in ("image/png", "text/plain")}
                if "image/png" in output.data:
                    output.data.pop("text/plain", None)  # only the size of the figure
    nbformat.validate(notebook)
    nbformat.write(notebook, path)
    print(f"{os.path.relpath(path)}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    # Before the kernel starts, because it inherits the environment.
    from cfb_mjx.runtime import set_up_xla

    set_up_xla()
    for name in sys.argv[1:] or sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")):
        execute(Path(name).resolve())
