"""Localize images against several maps, and all images of a folder on several threads."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import NamedTuple, get_args

import pycolmap

from slimsfm.arrays import GrayImage, Image
from slimsfm.execution import map_on_threads, num_cores
from slimsfm.features import Features
from slimsfm.image_files import check_names, list_images
from slimsfm.localization.cameras import QueryCamera, query_camera
from slimsfm.localization.localizer import Localizer
from slimsfm.localization.outcome import Localization
from slimsfm.localization.shared_cameras import corrected_cameras, share_cameras
from slimsfm.photos import Orientation, read_photo
from slimsfm.pose import Gravity
from slimsfm.progress import ProgressBar, silent


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
        extracted: dict[str, Features] = {}
        found = {}
        for name, localizer in self.localizers.items():
            camera = localizer.camera_of(image, (cameras or {}).get(name))
            info, start = localizer.map.info, perf_counter()
            key = repr((info.extractor, sorted(info.extractor_options.items())))
            if key not in extracted:
                extracted[key] = localizer.extractor.extract(image, mask)
            seconds = perf_counter() - start
            one = localizer.localize_features(extracted[key], camera, gravity)
            found[name] = replace(one, seconds=replace(one.seconds, extract=seconds))
        return found


_ONLY = ""  # name of the object where there is one map


def localize_images(
    localizer: Localizer,
    images: str | Path,
    *,
    camera: pycolmap.Camera | None = None,
    gravity: Mapping[str, Gravity] | None = None,
    workers: int | None = None,
    progress: ProgressBar = silent,
) -> dict[str, Localization]:
    """Localize the images of a folder.

    Results do not depend on the number of workers. Transparent pixels of an image hold no features,
    unless all are.

    Args:
        localizer: Localizer of the map.
        images: A folder, searched recursively, or one image file.
        camera: Intrinsics of all images, scaled to the size of each; chosen per image by `query_camera` if
            not given.
        gravity: Direction of gravity by image name; images may be missing.
        workers: Images to localize at a time; the number of cores if not given.
        progress: Progress bar, one step per image.

    Returns:
        The outcome of each image, localized or not, by its name relative to the folder, in sorted order.

    Raises:
        InputError: There is no image.
        ImageError: An image cannot be read, or its intrinsics are not known well enough.
        ValueError: `workers` is below 1.
    """
    multi = MultiLocalizer({_ONLY: localizer})
    return _localize(multi, Path(images), camera, gravity or {}, workers, progress)[_ONLY]


def localize_objects(
    localizer: MultiLocalizer,
    images: str | Path,
    *,
    camera: pycolmap.Camera | None = None,
    workers: int | None = None,
    progress: ProgressBar = silent,
) -> dict[str, dict[str, Localization]]:
    """Search the images of a folder for several objects.

    Arguments and errors are those of `localize_images`. Gravity is not among them because each map has a
    frame of its own.

    Returns:
        For each object, in the order of the localizers, the outcome of each image by its name.
    """
    return _localize(localizer, Path(images), camera, {}, workers, progress)


class _Task(NamedTuple):
    name: str
    path: Path
    cameras: Mapping[str, QueryCamera]


def _localize(
    localizer: MultiLocalizer,
    images: Path,
    camera: pycolmap.Camera | None,
    gravity: Mapping[str, Gravity],
    workers: int | None,
    progress: ProgressBar,
) -> dict[str, dict[str, Localization]]:
    if workers is not None and workers < 1:
        raise ValueError(f"workers must be at least 1, got {workers}")
    run = partial(_localize_all, localizer, gravity, workers or num_cores())
    tasks = _with_shared_cameras(_tasks(localizer, images, camera), localizer, run)
    strategies = {one.options.strategy_for(one.map) for one in localizer.localizers.values()}
    label = f"localize ({', '.join(sorted(strategies))})"
    outcomes = run(tasks)
    by_image = {task.name: next(outcomes) for task in progress(tasks, label)}
    again = list(_with_corrected_cameras(tasks, localizer, by_image))
    for task, found in zip(again, run(again), strict=True):
        by_image[task.name] = {**by_image[task.name], **found}
    return {key: {name: outcomes[key] for name, outcomes in by_image.items()} for key in localizer.localizers}


def _tasks(localizer: MultiLocalizer, images: Path, camera: pycolmap.Camera | None) -> list[_Task]:
    """All images with their intrinsics, so that an image without intrinsics fails before the work begins."""
    folder, names = (images.parent, [images.name]) if images.is_file() else (images, list_images(images))
    check_names(folder, names)
    return [
        _Task(
            name=name,
            path=folder / name,
            cameras={
                key: query_camera(one.map, folder / name, camera, one.options.focal)
                for key, one in localizer.localizers.items()
            },
        )
        for name in names
    ]


def _with_shared_cameras(tasks: list[_Task], localizer: MultiLocalizer, run: "_Run") -> list[_Task]:
    """The images, with focal lengths that those of one camera agree on where the user leaves it open."""
    by_name = {task.name: task for task in tasks}
    for key, one in localizer.localizers.items():
        if one.options.focal == "auto":
            cameras = {task.name: task.cameras[key] for task in tasks}
            shared = share_cameras(cameras, lambda some, key=key: _outcomes(run, by_name, some, key))
            for name, camera in shared.items():
                by_name[name] = by_name[name]._replace(cameras={**by_name[name].cameras, key: camera})
    return list(by_name.values())


def _outcomes(run: "_Run", tasks: Mapping[str, _Task], names: Sequence[str], key: str) -> list[Localization]:
    some = [tasks[name]._replace(cameras={key: tasks[name].cameras[key]}) for name in names]
    return [found[key] for found in run(some)]


def _with_corrected_cameras(
    tasks: list[_Task], localizer: MultiLocalizer, by_image: Mapping[str, Mapping[str, Localization]]
) -> Iterator[_Task]:
    """The images to localize again, because most others of their camera contradicted it."""
    for key, one in localizer.localizers.items():
        if one.options.focal == "auto":
            cameras = {task.name: task.cameras[key] for task in tasks}
            found = {name: outcomes[key] for name, outcomes in by_image.items()}
            corrected = corrected_cameras(cameras, found)
            yield from (
                task._replace(cameras={key: corrected[task.name]}) for task in tasks if task.name in corrected
            )


_Run = Callable[[Sequence[_Task]], Iterator[dict[str, Localization]]]


def _localize_all(
    localizer: MultiLocalizer, gravity: Mapping[str, Gravity], workers: int, tasks: Sequence[_Task]
) -> Iterator[dict[str, Localization]]:
    return map_on_threads(partial(_localize_one, localizer, gravity), tasks, workers)


def _localize_one(
    localizer: MultiLocalizer, gravity: Mapping[str, Gravity], task: _Task
) -> dict[str, Localization]:
    """Localize an image against the maps that its task has cameras for; it is read as each of them says."""
    found: dict[str, Localization] = {}
    wanted = {key: one for key, one in localizer.localizers.items() if key in task.cameras}
    for orientation in get_args(Orientation):
        alike = {k: one for k, one in wanted.items() if one.map.info.orientation == orientation}
        if alike:
            photo = read_photo(task.path, orientation)
            multi, down = MultiLocalizer(alike), gravity.get(task.name)
            found |= multi.localize(photo.image, task.cameras, down, photo.visible)
    return {key: found[key] for key in wanted}
