"""The OnePose_LowTexture data set of OnePose++ [1].

It lies on disk as OnePose's does (see `onepose`): in lowtexture_test_data, 40 objects called like
0700-toyrobot-others with two sequences each, of which the crops are published. What it has besides are
scanned models of eight objects, published by themselves. They belong where the authors' evaluation looks:

    ROOT/OBJECT/model_eval.ply    the model, in the object's frame, in metres; else ROOT/OBJECT/model.ply
    ROOT/OBJECT/diameter.txt      one number: its diameter, in metres; may be missing

Without diameter.txt the diameter is the largest distance of two vertices; the authors take the diagonal of
the model's axis-aligned box instead, which is a little longer. No object counts as symmetric.

References:
    [1] He et al., OnePose++: Keypoint-Free One-Shot Object Pose Estimation without CAD Models, NeurIPS 2022.
        https://github.com/zju3dv/OnePose_Plus_Plus
"""

from dataclasses import dataclass, replace
from pathlib import Path

from slimsfm.datasets.base import Making, ObjectModel, ObjectSequences
from slimsfm.datasets.object_model import check_size, read_object_model
from slimsfm.datasets.onepose import Frames, object_names, read_object
from slimsfm.datasets.reading import check_frame_step, check_known, read_matrix
from slimsfm.geometry import Box


@dataclass(frozen=True, kw_only=True)
class OnePoseLowTexture:
    """OnePose++'s objects with little texture, some of them with scanned models."""

    path: Path
    """Folder whose folders are the objects: lowtexture_test_data."""

    frames: Frames = "cropped"
    """The published crops around the object, from color, or full frames of the videos, from color_full."""

    frame_step: int = 15
    """Take each so manyth frame of the videos; 15 gives two a second."""

    def __post_init__(self) -> None:
        check_frame_step(self.frame_step)

    def names(self) -> tuple[str, ...]:
        """The objects, sorted."""
        return object_names(self.path)

    def load(self, name: str, making: Making) -> ObjectSequences:  # noqa: ARG002
        """Read one object, with its model where it was scanned."""
        check_known(name, self.names(), self.path)
        made = read_object(self.path / name, frame_step=self.frame_step, frames=self.frames)
        return replace(made, model=_read_scan(self.path / name, made.box))


def _read_scan(directory: Path, box: Box) -> ObjectModel | None:
    scans = [path for name in ("model_eval.ply", "model.ply") if (path := directory / name).is_file()]
    if not scans:
        return None
    diameter = None
    if (path := directory / "diameter.txt").exists():
        diameter = float(read_matrix(path, (1,), 1)[0, 0])
        check_size(diameter, box, f"{path}, in metres,")
    return read_object_model(scans[0], box, diameter=diameter, symmetric=False)
