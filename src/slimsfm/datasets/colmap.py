"""A COLMAP model of all images, queries included, as a data set.

    PROJECT/sparse/0/    the model, binary or text; or any other folder that holds one
    PROJECT/database.db  COLMAP's database, with the descriptors; may be missing
    IMAGES/              the images of the model, by the names that it has for them

Its poses are taken for true, in its own frame and unit. Descriptors of its keypoints come from hloc's
features or from a database, where one is named or lies in the project, and else are SIFT's, computed from the
images.
"""

from dataclasses import dataclass
from pathlib import Path

from slimsfm.datasets.base import Making, ObjectSequences
from slimsfm.datasets.images import query_names, sequences_of
from slimsfm.datasets.reading import check_known, image_size, read_text
from slimsfm.errors import ImageError, InputError
from slimsfm.mapping.importing import ImportOptions, import_colmap
from slimsfm.mapping.map import Map


@dataclass(frozen=True, kw_only=True)
class Colmap:
    """A COLMAP model, some of whose images are queries."""

    path: Path
    """Folder of the model, such as PROJECT/sparse/0."""

    images: Path
    """Folder of its images."""

    queries: Path | None = None
    """Text file with the names of the images that are queries, one a line; what follows a name in hloc's
    lists is not read. Without it every n-th is one."""

    query_every: int = 3
    """Every n-th image in order of name, from the first, is a query, where no file lists them."""

    database: Path | None = None
    """The model's COLMAP database; else the one in its project is taken."""

    features: Path | None = None
    """hloc's features.h5, instead of a database."""

    matches: Path | None = None
    """hloc's matches.h5, to go with `features`."""

    extractor: str = "sift"
    """Name of the extractor that made `features`."""

    box: Path | None = None
    """The object's box: JSON or OnePose's box3d_corners.txt. Without it the box is estimated."""

    def __post_init__(self) -> None:
        ImportOptions(database=self.database, features=self.features, matches=self.matches)

    def names(self) -> tuple[str, ...]:
        """The one object, called as the folder of the project or, where there is none, of the model."""
        return (self._project.name,)

    def load(self, name: str, making: Making) -> ObjectSequences:
        """Import the model, and hold the queries out."""
        check_known(name, self.names(), self.path)
        truth = import_colmap(self.path, options=self._import_options(), progress=making.progress)
        for one in truth.images:
            self._check_image(truth, one)
        listed = self.queries
        queries = _listed(listed, truth) if listed else query_names(list(truth.images), self.query_every)
        return sequences_of(truth, name, self.images, queries)

    @property
    def _project(self) -> Path:
        """The folder above those that COLMAP makes for its models."""
        path = self.path.resolve()
        while path.name.isdecimal() or path.name == "sparse":
            path = path.parent
        return path

    def _import_options(self) -> ImportOptions:
        database = self.database
        if database is None and self.features is None:
            places = [folder / "database.db" for folder in (self.path, self._project)]
            database = next((place for place in places if place.is_file()), None)
        return ImportOptions(
            database=database,
            features=self.features,
            images=None if database or self.features else self.images,
            matches=self.matches,
            extractor=self.extractor,
            box=self.box,
        )

    def _check_image(self, truth: Map, name: str) -> None:
        path, camera = self.images / name, truth.camera(name)
        if (size := image_size(path)) != (camera.width, camera.height):
            raise ImageError(
                f"{path} has {size[0]}x{size[1]} pixels, but its camera in the model {camera.width}x"
                f"{camera.height}: give the images that the model was made of"
            )


def _listed(path: Path, truth: Map) -> list[str]:
    """The images that a file lists.

    Raises:
        InputError: It lists none or one that the model does not have, or leaves too few to map.
    """
    lines = [line.strip() for line in read_text(path).splitlines() if line.strip()]
    queries = {line if line in truth.images else line.split()[0] for line in lines}
    if strange := sorted(queries - truth.images.keys()):
        raise InputError(f"{path}: lists {strange[0]!r}, of which the model has no pose; take it out")
    if not queries or len(truth.images) - len(queries) < 2:
        raise InputError(
            f"{path}: lists {len(queries)} of the model's {len(truth.images)} images; "
            "it takes one query and leaves two that map"
        )
    return sorted(queries)
