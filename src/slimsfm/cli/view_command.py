"""`slimsfm view`."""

from pathlib import Path
from time import sleep
from typing import Annotated

from slimsfm.cli.arguments import Networks, Reading
from slimsfm.cli.options import Advanced, MapPath
from slimsfm.cli.output import console, print_warnings
from slimsfm.errors import InputError
from slimsfm.localization.cameras import FocalLength
from slimsfm.mapping.camera_file import read_camera
from slimsfm.mapping.io import bytes_by_part, read_map
from slimsfm.progress import shown


def view(
    map: MapPath,
    /,
    reduced: Path | None = None,
    images: Path | None = None,
    queries: Path | None = None,
    camera: Path | None = None,
    focal: FocalLength = "auto",
    networks: Annotated[Networks, Advanced()] = Networks(),
    reading: Annotated[Reading, Advanced()] = Reading(),
    port: int = 8080,
    host: str = "localhost",
) -> None:
    """Show a map in the browser, and localize images in it by a click.

    Args:
        map: A map.
        reduced: A map that was reduced from it, to switch between the two.
        images: Folder of the map's photos, to show them in their cameras.
        queries: Folder of images to localize.
        camera: Intrinsics of the queries in COLMAP's cameras.txt format. Without it, those of the map where
            size and EXIF fit, else from EXIF; else the focal length is estimated.
        focal: How far the queries' focal length is believed, as in localize.
        networks: Where learned methods run.
        reading: Limits on what is read.
        port: Port of the view; 0 picks a free one.
        host: Address of the view: localhost serves this machine only, 0.0.0.0 the whole network, to those who
            have the printed address: it then holds a token.
    """
    try:
        from slimsfm.report.live import LiveQueries, MapWithSize, live_view
    except ModuleNotFoundError as error:
        raise InputError(
            f"view needs {error.name}, which is not installed: pip install 'slimsfm[view]'"
        ) from error
    networks.apply()
    reading.apply()
    if images and not images.is_dir():
        raise InputError(f"{images}: no such folder of images")
    given = read_camera(camera) if camera else None
    asked = LiveQueries(folder=queries, camera=given, focal=focal) if queries else None
    paths = [map, reduced] if reduced else [map]
    maps = [MapWithSize(map=read_map(path), num_bytes=bytes_by_part(path)["total"]) for path in paths]
    try:
        with live_view(*maps, queries=asked, host=host, port=port) as live:
            names = " and ".join(str(path) for path in paths)
            console.print(f"{live.address} shows {names}; Ctrl-C stops it")
            print_warnings(maps[0].map)
            if images and (missing := live.show_photos(images, shown)):
                count = f"{missing} of {len(live.scene.frusta)}"
                console.print(f"{images}: {count} photos are missing or unreadable", style="yellow")
            while True:
                sleep(3600)
    except KeyboardInterrupt:
        print("stopped")  # rich would repeat a line whose printing was interrupted
