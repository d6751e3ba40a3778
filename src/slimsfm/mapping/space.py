"""How much room a new map needs at least, told from its sources before the work."""

from collections.abc import Sequence
from pathlib import Path

from slimsfm.errors import InputError
from slimsfm.image_files import find_images
from slimsfm.mapping.work import BuildOptions

_FEATURE = 150  # bytes of a SIFT feature in features.h5; learned features take more
_FEATURES = 2048  # of a photo, where nothing else is asked for
_COPIES = 2  # features as they are extracted, and in the map or COLMAP's database
_IN_MODEL = 24  # bytes of a keypoint in images.bin


def bytes_to_build(sources: Sequence[Path], options: BuildOptions) -> int:
    """Bytes of the features of folders of photos, in the files of a build that hold a copy of them.

    A photo is taken to have no more bytes of features than its file has. Videos count nothing. 0 if there is
    no photo.
    """
    return sum(_bytes_of_folder(source, options) for source in sources)


def _bytes_of_folder(images: Path, options: BuildOptions) -> int:
    try:
        names = find_images(images, leave_out=options.masks).names
    except InputError:
        return 0
    most = _FEATURE * (options.max_features or _FEATURES)
    return _COPIES * sum(min(most, (images / name).stat().st_size) for name in names)


def bytes_to_import(model: Path) -> int:
    """Bytes of the features of a COLMAP model; 0 if it is none."""
    files = [path for path in (model / "images.bin", model / "images.txt") if path.is_file()]
    return sum(path.stat().st_size for path in files[:1]) * _FEATURE // _IN_MODEL
