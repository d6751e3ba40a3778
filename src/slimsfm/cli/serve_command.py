"""`slimsfm serve`."""

from contextlib import suppress
from pathlib import Path
from typing import Annotated

from slimsfm.cli.arguments import Networks, Reading
from slimsfm.cli.options import Advanced, Argument
from slimsfm.cli.output import console
from slimsfm.errors import InputError
from slimsfm.localization import LocalizationOptions
from slimsfm.tracking import TrackerOptions


def serve(
    maps: Annotated[tuple[Path, ...], Argument("MAP")],
    /,
    host: str = "localhost",
    port: int = 8000,
    token: str = "",
    cert: Path | None = None,
    key: Path | None = None,
    record: Path | None = None,
    film: Path | None = None,
    origins: tuple[str, ...] = (),
    workers: int | None = None,
    localization: Annotated[LocalizationOptions, Advanced()] = LocalizationOptions(),
    tracker: Annotated[TrackerOptions, Advanced()] = TrackerOptions(),
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
        record: Folder for images that clients send, with their poses; by default none is kept.
        film: Video that the page offers instead of a camera.
        origins: Foreign pages that may send requests, such as https://example.org.
        workers: Number of threads that localize, by default the number of cores.
        localization: How to localize.
        tracker: How to track.
        networks: Where learned methods run.
        reading: Limits on what is read.
    """
    try:
        from slimsfm.serve.announcing import announcement
        from slimsfm.serve.options import ServeLimits, ServeOptions
        from slimsfm.serve.running import Binding, MapServer, silence_uvicorn
    except ModuleNotFoundError as error:
        raise InputError(
            f"serve needs {error.name}, which is not installed: pip install 'slimsfm[serve]'"
        ) from error
    networks.apply()
    reading.apply()
    if film and not film.is_file():
        raise InputError(f"{film}: no such video")
    if workers is not None and workers < 1:
        raise InputError(f"workers must be at least 1, got {workers}")
    options = ServeOptions(
        maps=maps,
        token=token,
        origins=origins,
        record=record,
        film=film,
        localization=localization,
        tracker=tracker,
        limits=ServeLimits(workers=workers) if workers else ServeLimits(),
    )
    silence_uvicorn()
    server = MapServer(options, Binding(host=host, port=port, cert=cert, key=key))
    with suppress(KeyboardInterrupt):
        server.run(lambda: console.print(announcement(server), highlight=False, markup=False, soft_wrap=True))
    print("stopped")
