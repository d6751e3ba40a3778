"""Structure from Motion in the pixels in which features were found.

An extractor shrinks large images, and its keypoints are as exact as the shrunk images are. COLMAP's limits
are in pixels. So it is given keypoints and cameras of the shrunk images, and the model is enlarged
afterwards; otherwise the same photo in eight times the resolution would have to agree eight times as well.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from slimsfm.features import Features, shrink_factor
from slimsfm.geometry import resized_camera
from slimsfm.mapping.scratch import put_keypoints


@dataclass(frozen=True, kw_only=True, eq=False)
class ShrunkImages:
    """Features and cameras of images that were shrunk by a factor each."""

    whole: Mapping[str, Features]
    """Features by image name, in pixels of the images."""

    whole_cameras: Mapping[str, pycolmap.Camera]
    """Cameras of the images; images with equal `camera_id` have one camera, and so one factor."""

    factors: Mapping[str, float]
    """Pixels of the image per pixel of the shrunk image, by image name."""

    @classmethod
    def by_extractor(
        cls, whole: Mapping[str, Features], cameras: Mapping[str, pycolmap.Camera], extractor_options: Mapping
    ) -> "ShrunkImages":
        """Images as an extractor with these options shrinks them."""
        factors = {
            name: shrink_factor(extractor_options, cameras[name].width, cameras[name].height)
            for name in whole
        }
        return cls(whole=whole, whole_cameras=cameras, factors=factors)

    @property
    def features(self) -> Mapping[str, Features]:
        """Features in pixels of the shrunk images, computed on access."""
        return _Shrunk(self.whole, self.factors)

    @property
    def cameras(self) -> dict[str, pycolmap.Camera]:
        """Cameras of the shrunk images."""
        return {name: resized_camera(self.whole_cameras[name], 1 / self.factors[name]) for name in self.whole}

    def enlarge(self, model: pycolmap.Reconstruction, *, known_cameras: bool) -> None:
        """Turn a model of the shrunk images into one of the images.

        Args:
            model: The model; its images have their names.
            known_cameras: Give it the cameras of the images as they are, because they were not refined.
        """
        names = {self.whole_cameras[name].camera_id: name for name in self.factors}
        names |= {image.camera_id: image.name for image in model.images.values()}
        for camera_id, camera in model.cameras.items():
            if camera_id not in names:
                continue  # of no image in the model
            name = names[camera_id]
            whole, factor = self.whole_cameras[name], self.factors[name]
            enlarged = whole if known_cameras else resized_camera(camera, factor)
            camera.params = enlarged.params.tolist()
            camera.width, camera.height = whole.width, whole.height
        put_keypoints(model, self.whole)
        if set(self.factors.values()) != {1.0}:
            model.update_point_3d_errors()


class _Shrunk(Mapping[str, Features]):
    def __init__(self, whole: Mapping[str, Features], factors: Mapping[str, float]) -> None:
        self._whole, self._factors = whole, factors

    def __getitem__(self, name: str) -> Features:
        return shrunk_features(self._whole[name], self._factors[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._whole)

    def __len__(self) -> int:
        return len(self._whole)


def shrunk_features(features: Features, factor: float) -> Features:
    """Features in pixels of an image that is smaller by a factor."""
    return replace(features, keypoints=(features.keypoints / factor).astype(np.float32))
