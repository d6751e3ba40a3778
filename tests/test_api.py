"""`import slimsfm` offers the whole path and loads nothing before it is used."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import slimsfm

HEAVY = ("torch", "matplotlib", "numpy", "scipy", "pycolmap", "cv2", "h5py", "rich")


@pytest.mark.parametrize("name", slimsfm.__all__)
def test_every_public_name_resolves(name):
    value = getattr(slimsfm, name)
    assert value.__name__ == name
    assert value.__module__.startswith("slimsfm.")
    assert value.__doc__


def test_dir_lists_every_public_name():
    assert set(slimsfm.__all__) <= set(dir(slimsfm))


def test_type_checkers_see_every_public_name():
    tree = ast.parse(Path(slimsfm.__file__).read_text(encoding="utf-8"))
    (checked,) = [one for one in tree.body if isinstance(one, ast.If)]
    imported = {name.name for line in checked.body if isinstance(line, ast.ImportFrom) for name in line.names}
    assert imported == set(slimsfm.__all__)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'slimsfm' has no attribute 'Mapp'"):
        _ = slimsfm.Mapp


def test_importing_loads_no_library():
    code = f"import sys, slimsfm; print([m for m in {HEAVY} if m in sys.modules])"
    found = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True)
    assert (found.returncode, found.stdout, found.stderr) == (0, "[]\n", "")


def test_the_package_is_typed():
    assert (Path(slimsfm.__file__).parent / "py.typed").is_file()
