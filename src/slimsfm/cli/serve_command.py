"""`slimsfm serve`."""

import webbrowser
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Annotated

from slimsfm.cli.arguments import Networks, Reading
from slimsfm.cli.options import Advanced, Argument
from slimsfm.cli.output import console
from slimsfm.errors import InputError
from slimsfm.localization import LocalizationOptions
from slimsfm.serve.options import LIVE_TRACKING
from slimsfm.tracking import TrackerOptions

if TYPE_CHECKING:
    from slimsfm.serve.options import ServeOptions
    from slimsfm.serve.running import Binding


def serve(
    maps: Annotated[tuple[Path, ...], Argument("MAP")],
    /,
    host: str = "localhost",
    port: int = 8000,
    token: str = "",
    cert: Path | None = None,
    key: Path | None = None,
    model: Path | None = None,
    anchor: Path | None = None,
    record: Path | None = None,
    film: Path | None = None,
    origins: tuple[str, ...] = (),
    workers: int | None = None,
    localization: Annotated[LocalizationOptions, Advanced()] = LocalizationOptions(),
    tracker: Annotated[TrackerOptions, Advanced()] = LIVE_TRACKING,
    networks: Annotated[Networks, Advanced()] = Networks(),
    reading: Annotated[Reading, Advanced()] = Reading(),
) -> None:
    """Localize images that phones, robots and programs send, and show it on a page for phones.

    Args:
        maps: Maps, by whose folders' names clients choose.
        host: Address of the server: localhost serves this machine only. 0.0.0.0 serves the whole network, by
            HTTPS and to those who have the token.
        port: Port of the server; 0 picks a free one.
        token: What clients must send; by default one is made where others than this machine are served.
        cert: Certificate for HTTPS (PEM). By default a small authority makes one, which phones trust once.
        key: Private key of the certificate (PEM).
        model: GLB, OBJ or PLY that the page draws at the object of the first map.
        anchor: Where the model is in the map, as JSON: {"scale": 1, "quaternion_xyzw": [x, y, z, w],
            "translation": [x, y, z]}. By default it fills the box.
        record: Folder for images that clients send, with their poses; by default none is kept.
        film: Video that the page offers instead of a camera.
        origins: Foreign pages that may send requests, such as https://example.org.
        workers: Number of threads that localize, by default the number of cores.
        localization: How to localize.
        tracker: How to track.
        networks: Where learned methods run.
        reading: Limits on what is read.
    """
    check_can_serve()
    from slimsfm.serve.options import ServeLimits, ServeOptions
    from slimsfm.serve.running import Binding

    networks.apply()
    reading.apply()
    if workers is not None and workers < 1:
        raise InputError(f"workers must be at least 1, got {workers}")
    if anchor and not model:
        raise InputError("anchor: an anchor goes with a model; give `model=FILE` too")
    if film and not film.is_file():
        raise InputError(f"{film}: no such video")
    options = ServeOptions(
        maps=maps,
        token=token,
        origins=origins,
        model=model,
        anchor=anchor,
        record=record,
        film=film,
        localization=localization,
        tracker=tracker,
        limits=ServeLimits(workers=workers) if workers else ServeLimits(),
    )
    serve_until_stopped(options, Binding(host=host, port=port, cert=cert, key=key))


def check_can_serve() -> None:
    """Check that the packages of the extra are installed.

    Raises:
        InputError: One is missing.
    """
    try:
        import slimsfm.serve.announcing  # noqa: F401
    except ModuleNotFoundError as error:
        raise InputError(
            f"serve needs {error.name}, which is not installed: pip install 'slimsfm[serve]'"
        ) from error


def serve_until_stopped(options: "ServeOptions", binding: "Binding", *, opens_page: bool = False) -> None:
    """Serve until Ctrl-C or SIGTERM, and print where; if asked, open the page and play the film."""
    from slimsfm.serve.announcing import announcement
    from slimsfm.serve.running import MapServer, silence_uvicorn, use_few_arenas

    silence_uvicorn()
    use_few_arenas()
    server = MapServer(options, binding)

    def announce() -> None:
        console.print(announcement(server), highlight=False, markup=False, soft_wrap=True)
        if opens_page:
            address, mark, token = server.urls[0].partition("#")
            playing = f"{address}?film{mark}{token}"
            Thread(target=webbrowser.open, args=(playing,), daemon=True).start()

    with suppress(KeyboardInterrupt):
        server.run(announce)
    print("stopped")
