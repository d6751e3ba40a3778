from dataclasses import dataclass
from pathlib import Path

import pytest
from PIL import Image

from slimsfm.mapping.build import KnownPoses, build_map
from slimsfm.mapping.map import Map
from slimsfm.synthetic.objects import OBJECTS
from slimsfm.synthetic.scene import Take, mapping_take, object_box

NUM_FRAMES = 8


@dataclass(frozen=True)
class Rendered:
    """Eight frames of a video of a printed box, as files."""

    folder: Path
    take: Take
    names: tuple[str, ...]

    @property
    def known(self) -> KnownPoses:
        camera = self.take.camera
        camera.camera_id = 1
        return KnownPoses(
            cameras=dict.fromkeys(self.names, camera),
            cam_from_world=dict(zip(self.names, self.take.cam_from_object[:NUM_FRAMES], strict=True)),
            box=object_box(OBJECTS["printed_box"](0)),
            unit="metre",
        )


@dataclass(frozen=True)
class Built:
    map: Map
    workspace: Path


@pytest.fixture(scope="session")
def rendered(tmp_path_factory) -> Rendered:
    folder = tmp_path_factory.mktemp("images")
    take = mapping_take("printed_box", 80, 320, 240, 0)
    names = tuple(f"take 1/frame {i}.png" for i in range(NUM_FRAMES))
    (folder / "take 1").mkdir()
    for i, name in enumerate(names):
        Image.fromarray(take.frame(i)).save(folder / name, compress_level=1)
    return Rendered(folder, take, names)


@pytest.fixture(scope="session")
def unposed(rendered, tmp_path_factory) -> Built:
    """Built from the images alone."""
    workspace = tmp_path_factory.mktemp("unposed")
    return Built(build_map(rendered.folder, workspace=workspace), workspace)


@pytest.fixture(scope="session")
def posed(rendered, tmp_path_factory) -> Built:
    """Built with the true poses."""
    workspace = tmp_path_factory.mktemp("posed")
    return Built(build_map(rendered.folder, known=rendered.known, workspace=workspace), workspace)
