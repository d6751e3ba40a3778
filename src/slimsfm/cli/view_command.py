"""`slimsfm view`."""

from pathlib import Path
from time import sleep

from slimsfm.cli.options import MapPath
from slimsfm.cli.output import console
from slimsfm.errors import InputError
from slimsfm.localization.cameras import FocalLength, read_camera
from slimsfm.mapping.io import bytes_by_part, read_map
from slimsfm.progress import shown


def view(
    map: MapPath,
    /,
    reduced: Path | None = None,
    images: Path | None = None,
    queries: Path | None = None,
    camera: Path | None = None,
    focal: FocalLength = "known",
    port: int = 8080,
    host: str = "localhost",
) -> None:
    """Show a map in the browser, and localize images in it by a click.

    Args:
        map: A map.
        reduced: A map that was reduced from it, to switch between the two.
        images: Folder of the map's photos, to be shown where they were taken.
        queries: Folder of images to localize.
        camera: Intrinsics of the queries, in COLMAP's cameras.txt format; else the map's or EXIF's.
        focal: How well the queries' focal length is known.
        port: Where the view is served; 0 is any free port.
        host: Whom it is served: localhost is this machine alone, 0.0.0.0 all who can reach it.
    """
    try:
        from slimsfm.report.live import WeighedMap, live_view
        from slimsfm.report.live_queries import QueryPanel
    except ModuleNotFoundError as error:
        raise InputError(
            f"view needs {error.name}, which is not installed: pip install 'slimsfm[view]'"
        ) from error
    if images and not images.is_dir():
        raise InputError(f"{images}: no such folder of images")
    given = read_camera(camera) if camera else None
    paths = [map, reduced] if reduced else [map]
    maps = [WeighedMap(map=read_map(path), num_bytes=bytes_by_part(path)["total"]) for path in paths]
    with live_view(*maps, host=host, port=port) as live:
        if queries:
            QueryPanel(live, queries, given, focal)
        console.print(f"{live.address} shows {' and '.join(str(path) for path in paths)}; Ctrl-C ends it")
        if images:
            missing = live.show_photos(images, shown)
            if missing:
                console.print(
                    f"{images}: {missing} of {len(live.frustums)} photos are missing or unreadable",
                    style="yellow",
                )
        while True:
            sleep(3600)
