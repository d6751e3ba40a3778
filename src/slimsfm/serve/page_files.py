"""The files of the page: those in the package's folder `page` and no others, read once."""

import mimetypes
from functools import cache
from pathlib import Path

from starlette.requests import Request
from starlette.responses import Response

from slimsfm.serve.errors import ApiError

_FOLDER = Path(__file__).parent / "page"
_TYPES = {".js": "text/javascript", ".css": "text/css", ".html": "text/html", ".svg": "image/svg+xml"}


async def index(request: Request) -> Response:  # noqa: ARG001
    """`GET /`."""
    return page_file("index.html")


async def named(request: Request) -> Response:
    """`GET /page/{name}`."""
    return page_file(request.path_params["name"])


def page_file(name: str) -> Response:
    """A file of the page.

    Raises:
        ApiError: There is no such file (404).
    """
    data = page_files().get(name)
    if data is None:
        raise ApiError(404, "not_found", "the page has no such file")
    suffix = Path(name).suffix
    kind = _TYPES.get(suffix) or mimetypes.guess_type(name)[0] or "application/octet-stream"
    return Response(data, media_type=kind, headers={"cache-control": "no-cache"})


@cache
def page_files() -> dict[str, bytes]:
    """The files by name."""
    return {path.name: path.read_bytes() for path in sorted(_FOLDER.glob("*")) if path.is_file()}
