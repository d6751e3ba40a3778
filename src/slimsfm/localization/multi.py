"""Localize an image against several maps: which objects it shows, and where."""

from collections.abc import Mapping
from dataclasses import replace
from time import perf_counter

import pycolmap

from slimsfm.arrays import Image
from slimsfm.features import Features
from slimsfm.localization.localizer import Localization, Localizer
from slimsfm.pose import Gravity


class MultiLocalizer:
    """Localizes images against several maps; extracts features once for maps with the same extractor.

    Attributes:
        localizers: The localizer of each object's map, by name of the object.
    """

    def __init__(self, localizers: Mapping[str, Localizer]) -> None:
        """Take a localizer for each object, by name of the object.

        Raises:
            ValueError: `localizers` is empty.
        """
        if not localizers:
            raise ValueError("localizers must hold at least one")
        self.localizers = dict(localizers)

    def localize(
        self,
        image: Image,
        cameras: Mapping[str, pycolmap.Camera | None] | None = None,
        gravity: Gravity | None = None,
    ) -> dict[str, Localization]:
        """Search one image for every object.

        Args:
            image: Upright RGB.
            cameras: Intrinsics by name of the object; where they are missing or None, those of the object's
                map are used.
            gravity: As in `Localizer.localize`; all maps must share one frame.

        Returns:
            The outcome by name of the object, in the order of the localizers. The image shows the objects
            that have a pose. The time of a shared extraction counts for the first object only.

        Raises:
            ValueError: As in `Localizer.localize`.
        """
        extracted: dict[str, Features] = {}
        found = {}
        for name, localizer in self.localizers.items():
            camera = localizer.camera_of(image, (cameras or {}).get(name))
            info, start = localizer.map.info, perf_counter()
            key = repr((info.extractor, sorted(info.extractor_options.items())))
            if key not in extracted:
                extracted[key] = localizer.extractor.extract(image)
            seconds = perf_counter() - start
            one = localizer.localize_features(extracted[key], camera, gravity)
            found[name] = replace(one, seconds=replace(one.seconds, extract=seconds))
        return found
