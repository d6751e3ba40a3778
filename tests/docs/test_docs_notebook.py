import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[2] / "examples" / "slimsfm.ipynb"
MOST_BYTES = 300_000


@pytest.fixture(scope="module")
def cells() -> list[dict]:
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    assert notebook["nbformat"] == 4
    return notebook["cells"]


def test_it_is_small_and_independent_of_the_machine(cells):
    assert NOTEBOOK.stat().st_size < MOST_BYTES
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert all(cell["execution_count"] is None for cell in code)
    pictures = [one for cell in code for one in cell["outputs"] if "image/png" in one.get("data", {})]
    assert len(pictures) >= 4
    assert "/tmp" not in NOTEBOOK.read_text(encoding="utf-8")


def without_numbers(text: str) -> str:
    """Times, and sometimes last digits, depend on the machine."""
    return re.sub(r"[\d.]+", "#", text)


def test_its_cells_run_in_order(cells, tmp_path):
    lines = "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    done = subprocess.run(
        [sys.executable, "-c", lines],
        cwd=tmp_path,
        env={**os.environ, "MPLBACKEND": "Agg"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    printed = [one["text"] for cell in cells for one in cell.get("outputs", ()) if "text" in one]
    shown = "".join(line for text in printed for line in text)
    assert without_numbers(done.stdout) == without_numbers(shown)
