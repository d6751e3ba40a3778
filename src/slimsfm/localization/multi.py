"""Several maps at once: which objects are in an image, and where."""

from collections.abc import Mapping
from dataclasses import replace
from time import perf_counter

import pycolmap

from slimsfm.arrays import Image
from slimsfm.features import Features
from slimsfm.localization.localizer import Localization, Localizer
from slimsfm.pose import Gravity


class MultiLocalizer:
    """Localizes images against several maps; features that maps have in common are extracted once."""

    def __init__(self, localizers: Mapping[str, Localizer]) -> None:
        """Take a localizer for each object, by name of the object.

        Raises:
            ValueError: There is none.
        """
        if not localizers:
            raise ValueError("localizers must hold at least one")
        self._localizers = dict(localizers)

    def localize(
        self,
        image: Image,
        cameras: Mapping[str, pycolmap.Camera | None] | None = None,
        gravity: Gravity | None = None,
    ) -> dict[str, Localization]:
        """Seek every object in one image.

        Args:
            image: Upright RGB.
            cameras: Intrinsics by object; None, or none given, stands for the camera of the object's map.
            gravity: As of `Localizer.localize`, in the frame that all maps share.

        Returns:
            A localization by object, in the order of the localizers; those with a pose are in the image. The
            time of extraction is told of the first that it serves.

        Raises:
            ValueError: As of `Localizer.localize`.
        """
        extracted: dict[str, Features] = {}
        found = {}
        for name, localizer in self._localizers.items():
            camera = localizer.camera_of(image, (cameras or {}).get(name))
            info, start = localizer.map.info, perf_counter()
            key = repr((info.extractor, sorted(info.extractor_options.items())))
            if key not in extracted:
                extracted[key] = localizer.extractor.extract(image)
            seconds = perf_counter() - start
            one = localizer.localize_features(extracted[key], camera, gravity)
            found[name] = replace(one, seconds=replace(one.seconds, extract=seconds))
        return found
