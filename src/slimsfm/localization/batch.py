"""Localize images against several maps, and all images of a folder on several threads."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np
import pycolmap

from slimsfm.arrays import GrayImage, Image
from slimsfm.execution import map_on_threads, num_cores
from slimsfm.image_files import check_names, list_images
from slimsfm.localization.cameras import QueryCamera, query_camera
from slimsfm.localization.localizer import Localizer
from slimsfm.localization.outcome import Localization
from slimsfm.localization.rounds import ImageRounds
from slimsfm.localization.shared_cameras import corrected_cameras, share_cameras
from slimsfm.photos import Orientation, read_photo
from slimsfm.pose import Gravity
from slimsfm.progress import ProgressBar, silent
from slimsfm.skipping import SkippedPhotos


class MultiLocalizer:
    """Localizes images against several maps; maps with the same extractor share what is extracted.

    Features of an image size are extracted once. Maps that begin with different sizes share less.

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
        cameras: Mapping[str, pycolmap.Camera | QueryCamera | None] | None = None,
        gravity: Gravity | None = None,
        mask: GrayImage | None = None,
    ) -> dict[str, Localization]:
        """Search one image for every object.

        Args:
            image: RGB, upright or as stored as the maps say.
            cameras: Intrinsics by name of the object; where they are missing or None, those of the object's
                map are used.
            gravity: As in `Localizer.localize`; all maps must share one frame.
            mask: As in `Localizer.localize`.

        Returns:
            The outcome by name of the object, in the order of the localizers. The image shows the objects
            that have a pose. The time of a shared extraction counts for the first object only.

        Raises:
            ValueError: As in `Localizer.localize`.
        """
        source, found = ImageRounds(image, mask), {}
        for name, localizer in self.localizers.items():
            camera = localizer.camera_of(image, (cameras or {}).get(name))
            found[name] = localizer.localize_in_rounds(source, camera, gravity)
        return found


_ONLY = ""  # name of the object where there is one map


def localize_images(
    localizer: Localizer,
    images: str | Path,
    *,
    camera: pycolmap.Camera | None = None,
    gravity: Mapping[str, Gravity] | None = None,
    workers: int | None = None,
    strict: bool = False,
    progress: ProgressBar = silent,
) -> dict[str, Localization]:
    """Localize the images of a folder.

    Results do not depend on the number of workers. Images that cannot be read, or whose intrinsics are not
    known well enough, are skipped with a warning; the others get the same poses as without them. Transparent
    pixels of an image hold no features, unless all are.

    Args:
        localizer: Localizer of the map.
        images: A folder, searched recursively, or one image file.
        camera: Intrinsics of all images, scaled to the size of each; chosen per image by `query_camera` if
            not given.
        gravity: Direction of gravity by image name; images may be missing.
        workers: Images to localize at a time; the number of cores if not given.
        strict: Whether to raise the error of the first image that cannot be used, instead of skipping it.
        progress: Progress bar, one step per image.

    Returns:
        The outcome of each image, localized or not or skipped, by its name relative to the folder, in sorted
        order.

    Raises:
        InputError: There is no image.
        ImageError: No image can be used or, if `strict`, one cannot.
        ValueError: `workers` is below 1.
    """
    multi = MultiLocalizer({_ONLY: localizer})
    batch = _Batch(multi, Path(images), gravity or {}, workers, strict=strict)
    return batch.localize(camera, progress)[_ONLY]


def localize_objects(
    localizer: MultiLocalizer,
    images: str | Path,
    *,
    camera: pycolmap.Camera | None = None,
    workers: int | None = None,
    strict: bool = False,
    progress: ProgressBar = silent,
) -> dict[str, dict[str, Localization]]:
    """Search the images of a folder for several objects.

    Arguments and errors are those of `localize_images`. Gravity is not among them because each map has a
    frame of its own.

    Returns:
        For each object, in the order of the localizers, the outcome of each image by its name.
    """
    return _Batch(localizer, Path(images), {}, workers, strict=strict).localize(camera, progress)


class _Task(NamedTuple):
    name: str
    path: Path
    cameras: Mapping[str, QueryCamera]  # by name of the object


_ByImage = dict[str, dict[str, Localization]]  # by name of the image, by name of the object


class _Batch:
    """Localizes the images of a folder; remembers those that cannot be used."""

    def __init__(
        self,
        localizer: MultiLocalizer,
        images: Path,
        gravity: Mapping[str, Gravity],
        workers: int | None,
        *,
        strict: bool,
    ) -> None:
        if workers is not None and workers < 1:
            raise ValueError(f"workers must be at least 1, got {workers}")
        is_one = images.is_file()
        self._folder, self._names = (
            (images.parent, [images.name]) if is_one else (images, list_images(images))
        )
        check_names(self._folder, self._names)
        self._maps, self._gravity = localizer.localizers, gravity
        self._workers, self._strict = workers or num_cores(), strict
        self._skipped = SkippedPhotos(self._folder, strict=strict)

    def localize(
        self, camera: pycolmap.Camera | None, progress: ProgressBar
    ) -> dict[str, dict[str, Localization]]:
        """The outcome of each image by name, by name of the object."""
        given = self._tasks(camera)
        tasks = self._with_shared_cameras(given)
        strategies = {one.options.strategy_for(one.map) for one in self._maps.values()}
        outcomes = self._run(tasks)
        by_image: _ByImage = {
            task.name: next(outcomes)
            for task in progress(tasks, f"localize ({', '.join(sorted(strategies))})")
        }
        left = set(self._skipped.left(self._names))
        if len(left) < len(tasks):  # cameras must not depend on images that turned out to be broken
            before = {task.name: task for task in tasks}
            tasks = self._with_shared_cameras([task for task in given if task.name in left])
            self._update(by_image, [one for one in tasks if _differ(one, before[one.name])])
        self._update(by_image, list(_with_corrected_cameras(tasks, self._maps, by_image)))
        return {key: {name: self._outcome(by_image, name, key) for name in self._names} for key in self._maps}

    def _tasks(self, camera: pycolmap.Camera | None) -> list[_Task]:
        """The images with their intrinsics; fails before the work begins if no image has any."""
        tasks = []
        for name in self._names:
            path = self._folder / name
            with self._skipped.skipping(name):
                cameras = {
                    key: query_camera(one.map, path, camera, one.options.focal)
                    for key, one in self._maps.items()
                }
                tasks.append(_Task(name=name, path=path, cameras=cameras))
        self._skipped.left(self._names)
        return tasks

    def _with_shared_cameras(self, tasks: list[_Task]) -> list[_Task]:
        """The images, with focal lengths that those of one camera agree on where the user leaves it open."""
        by_name = {task.name: task for task in tasks}
        for key, one in self._maps.items():
            if one.options.focal == "auto":
                cameras = {task.name: task.cameras[key] for task in tasks}
                shared = share_cameras(cameras, lambda some, key=key: self._outcomes(by_name, some, key))
                for name, camera in shared.items():
                    by_name[name] = by_name[name]._replace(cameras={**by_name[name].cameras, key: camera})
        return list(by_name.values())

    def _outcomes(self, tasks: Mapping[str, _Task], names: Sequence[str], key: str) -> list[Localization]:
        some = [tasks[name]._replace(cameras={key: tasks[name].cameras[key]}) for name in names]
        return [found[key] for found in self._run(some) if found]

    def _run(self, tasks: Sequence[_Task]) -> Iterator[dict[str, Localization]]:
        return map_on_threads(self._localize_one, tasks, self._workers)

    def _localize_one(self, task: _Task) -> dict[str, Localization]:
        """Localize an image against the maps that its task has cameras for, read as each of them says.

        Returns nothing if the image cannot be read.
        """
        found: dict[str, Localization] = {}
        wanted = {key: one for key, one in self._maps.items() if key in task.cameras}
        if task.name in self._skipped.reasons:
            return {}
        with self._skipped.skipping(task.name):
            for orientation in get_args(Orientation):
                alike = {k: one for k, one in wanted.items() if one.map.info.orientation == orientation}
                if alike:
                    photo = read_photo(task.path, orientation)
                    multi, down = MultiLocalizer(alike), self._gravity.get(task.name)
                    found |= multi.localize(photo.image, task.cameras, down, photo.visible)
            return {key: found[key] for key in wanted}
        return {}

    def _outcome(self, by_image: _ByImage, name: str, key: str) -> Localization:
        if reason := self._skipped.reasons.get(name):
            return Localization.skipped(reason, self._maps[key].map.info.orientation)
        return by_image[name][key]

    def _update(self, by_image: _ByImage, again: Sequence[_Task]) -> None:
        """Localize images again, with other cameras."""
        for task, found in zip(again, self._run(again), strict=True):
            by_image[task.name] = {**by_image[task.name], **found}


def _differ(one: _Task, other: _Task) -> bool:
    """Whether an image has got another camera."""
    pairs = [(one.cameras[key], other.cameras[key]) for key in one.cameras]
    return any(a.source != b.source or not np.array_equal(a.camera.params, b.camera.params) for a, b in pairs)


def _with_corrected_cameras(
    tasks: list[_Task], maps: Mapping[str, Localizer], by_image: _ByImage
) -> Iterator[_Task]:
    """The images to localize again, because most others of their camera contradicted it."""
    for key, one in maps.items():
        if one.options.focal == "auto":
            cameras = {task.name: task.cameras[key] for task in tasks}
            found = {name: by_image[name][key] for name in cameras}
            corrected = corrected_cameras(cameras, found)
            yield from (
                task._replace(cameras={key: corrected[task.name]}) for task in tasks if task.name in corrected
            )
