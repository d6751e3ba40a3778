from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from slimsfm.datasets.synthetic import SynthesisOptions, synthesize
from slimsfm.errors import OutputError
from slimsfm.geometry import project

OPTIONS = SynthesisOptions(objects=("can",), mapping_frames=3, query_frames=2, width=64, height=48)


def contents(folder):
    return {
        path.relative_to(folder): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()
    }


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("synthetic")
    return folder, synthesize(folder, OPTIONS)


def test_rendered_objects_are_read_with_frames_that_show_them(written):
    _, (item,) = written
    assert item.name == "can"
    assert (len(item.mapping.image_paths), len(item.query.image_paths)) == (3, 2)
    image = np.asarray(Image.open(item.mapping.image_paths[0]))
    assert image.shape == (48, 64, 3)
    corners = project(item.box.corners, item.mapping.cam_from_world[0], item.mapping.cameras[0])
    assert np.all((corners > 0) & (corners < (64, 48)))


def test_equal_options_give_equal_bytes_wherever_frames_are_rendered(written, tmp_path):
    synthesize(tmp_path / "other", replace(OPTIONS, seed=OPTIONS.seed + 1))  # replaces what is cached
    with ThreadPoolExecutor(2) as executor:
        synthesize(tmp_path / "again", OPTIONS, executor=executor)
    assert contents(tmp_path / "again") == contents(written[0])


def test_an_existing_object_is_replaced_only_with_overwrite(tmp_path):
    old = tmp_path / "can" / "notes.txt"
    old.parent.mkdir()
    old.write_text("mine")
    with pytest.raises(OutputError, match="exists already"):
        synthesize(tmp_path, OPTIONS)
    assert old.read_text() == "mine"
    synthesize(tmp_path, OPTIONS, overwrite=True)
    assert not old.exists()


def test_progress_counts_frames_and_an_interruption_leaves_no_files(tmp_path):
    seen = []

    def interrupt(items, label):
        for item in items:
            seen.append(label)
            if len(seen) == 3:
                raise KeyboardInterrupt
            yield item

    with pytest.raises(KeyboardInterrupt):
        synthesize(tmp_path, OPTIONS, progress=interrupt)
    assert seen == ["rendering can"] * 3
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "values",
    [
        {"objects": ("teapot",)},
        {"objects": ()},
        {"objects": ("can", "can")},
        {"width": 0},
        {"query_frames": 0},
        {"seed": -1},
    ],
    ids=str,
)
def test_invalid_options_are_named_in_the_error(values):
    with pytest.raises(ValueError, match=next(iter(values))):
        SynthesisOptions(**values)
