"""The handlers of HTTP requests."""

import asyncio
from collections.abc import Callable
from time import perf_counter

from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response

from slimsfm.serve.bodies import read_body
from slimsfm.serve.errors import ApiError, bad_request
from slimsfm.serve.localizing import localize_bytes
from slimsfm.serve.queries import query_of
from slimsfm.serve.replies import Json, map_reply, points_reply
from slimsfm.serve.service import Service

_IMAGE_TYPES = ("image/", "application/octet-stream", "binary/octet-stream")
_CURLS_DEFAULT = "application/x-www-form-urlencoded"  # what `curl --data-binary` says of any file


def service_of(request: Request) -> Service:
    """What the handlers share."""
    return request.app.state.service


async def localize(request: Request) -> Response:
    """`POST /v1/localize`."""
    start, service = perf_counter(), service_of(request)
    query = query_of(single_parameters(request))
    maps = service.store.select(query.maps)
    _check_type(request)
    service.rate.take(client_of(request))
    data = await read_body(request, service.options.limits)
    received = perf_counter()

    def work() -> Json:
        return localize_bytes(maps, query, data)

    reply = await run_unless_aborted(request, "localize", work)
    for one in reply.get("maps", [reply]):
        service.metrics.count("localizations_total", map=one["map"], found=str(one["found"]).lower())
    request_id = request.scope["slimsfm.request_id"]
    await asyncio.to_thread(service.recorder.keep, request_id, data, reply)
    end = perf_counter()
    waited = end - received - 1e-3 * reply["ms"]["work"]
    ms = {
        "receive": round(1e3 * (received - start), 3),
        "wait": round(max(0.0, 1e3 * waited), 3),
        **{stage: value for stage, value in reply["ms"].items() if stage != "work"},
        "total": round(1e3 * (end - start), 3),
    }
    return JSONResponse({**reply, "ms": ms, "request_id": request_id})


async def run_unless_aborted(request: Request, kind: str, work: Callable[[], Json]) -> Json:
    """Run work on a worker; if the client leaves while it waits, it is not begun.

    Raises:
        ApiError: It is refused, too late or fails; or the client left (400).
    """
    service = service_of(request)
    deadline_s = service.options.limits.deadline_s
    job = asyncio.ensure_future(service.pool.run(client_of(request), kind, work, deadline_s))
    leaving = asyncio.ensure_future(request.receive())  # after the body, only a disconnect can come
    try:
        await asyncio.wait({job, leaving}, return_when=asyncio.FIRST_COMPLETED)
        if not job.done():
            job.cancel()
            raise bad_request("aborted", "the client left")
        return job.result()
    finally:
        leaving.cancel()


async def list_maps(request: Request) -> Response:
    """`GET /v1/maps`."""
    service = service_of(request)
    maps = [map_reply(service.store[key]) for key in service.store.ids]
    return JSONResponse({"maps": maps, "film": service.options.film is not None})


async def show_map(request: Request) -> Response:
    """`GET /v1/maps/{id}`."""
    return JSONResponse(map_reply(service_of(request).store[request.path_params["id"]]))


async def show_points(request: Request) -> Response:
    """`GET /v1/maps/{id}/points`."""
    served = service_of(request).store[request.path_params["id"]]
    return JSONResponse(await asyncio.to_thread(points_reply, served))


async def healthz(request: Request) -> Response:
    """`GET /healthz`: whether the server answers; 503 while it stops."""
    if service_of(request).sessions.ended:
        raise ApiError(503, "stopping", "the server stops", 5.0)
    return JSONResponse({"status": "ok"})


async def metrics(request: Request) -> Response:
    """`GET /metrics`."""
    kind = "text/plain; version=0.0.4; charset=utf-8"
    return PlainTextResponse(service_of(request).metrics_text(), media_type=kind)


def client_of(request: Request) -> str:
    """The address of a client."""
    return request.client.host if request.client else ""


def single_parameters(request: Request) -> dict[str, str]:
    """The parameters of a request.

    Raises:
        ApiError: One is given twice (400).
    """
    pairs = request.query_params.multi_items()
    parameters = dict(pairs)
    if len(parameters) < len(pairs):
        raise bad_request("bad_parameter", "a parameter is given twice")
    return parameters


def _check_type(request: Request) -> None:
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind and kind != _CURLS_DEFAULT and not kind.startswith(_IMAGE_TYPES):
        raise ApiError(
            415,
            "bad_content_type",
            "send the image file itself as the body: image/jpeg, image/png or image/webp",
        )
