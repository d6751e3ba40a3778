"""The extractor that a map was built with."""

from slimsfm.errors import InputError, MapError
from slimsfm.features import Extractor, load_extractor
from slimsfm.mapping.map import Map


def extractor_of(map: Map) -> Extractor:
    """Create the extractor that a map was built with, for its queries.

    Raises:
        MapError: The options of the extractor in the map are impossible.
        InputError: A package or weights that the extractor needs are missing.
    """
    try:
        return load_extractor(map.info.extractor, map.info.extractor_options)
    except InputError as error:
        if isinstance(error.__cause__, TypeError | ValueError):
            raise MapError(f"the map's {error}; build or import the map again") from error
        raise
