import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def test_layers_import_downward_only():
    found = subprocess.run(
        [sys.executable, "-c", "from importlinter.cli import lint_imports_command; lint_imports_command()"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert found.returncode == 0, found.stdout + found.stderr
    assert "0 broken" in found.stdout


@pytest.mark.parametrize("module", ["slimsfm", "slimsfm.cli", "slimsfm.localization", "slimsfm.reduction"])
def test_importing_prints_nothing_and_loads_no_deep_learning(module):
    code = (
        f"import sys, {module}; print([m for m in ('torch', 'transformers', 'kornia') if m in sys.modules])"
    )
    found = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], cwd=ROOT / "src", capture_output=True, text=True
    )
    assert (found.returncode, found.stdout, found.stderr) == (0, "[]\n", "")


def test_importing_the_command_line_loads_no_slow_library():
    slow = ("numpy", "pycolmap", "cv2", "scipy", "rich")
    code = f"import sys, slimsfm.cli; print([m for m in {slow} if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], cwd=ROOT / "src", capture_output=True, text=True)
    assert found.stdout == "[]\n"
