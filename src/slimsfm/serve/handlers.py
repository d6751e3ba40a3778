"""The handlers of HTTP requests."""

import asyncio
from collections.abc import Callable
from time import perf_counter

from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response

from slimsfm.serve.bodies import read_body
from slimsfm.serve.errors import ApiError, bad_request
from slimsfm.serve.geopose import geopose_response, parse_geopose_request
from slimsfm.serve.localizing import localize_bytes
from slimsfm.serve.openapi import OPENAPI
from slimsfm.serve.queries import LocalizeQuery, query_of
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


async def localize_geopose(request: Request) -> Response:
    """`POST /oscp/localize/geopose`: the same by the protocol of the Open AR Cloud."""
    service = service_of(request)
    service.rate.take(client_of(request))
    asked = parse_geopose_request(await read_body(request, service.options.limits))
    maps = [one for one in service.store.select(()) if one.localizer.map.info.georeference]
    if not maps:
        raise ApiError(404, "not_georeferenced", "no map says where on the earth it is")

    def work() -> Json:
        return localize_bytes(maps, LocalizeQuery(camera=asked.camera), asked.image)

    reply = await run_unless_aborted(request, "localize", work)
    return JSONResponse(geopose_response(asked, reply))


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


async def show_model(request: Request) -> Response:
    """`GET /v1/maps/{id}/model`: what the page draws in the place of an object."""
    served = service_of(request).store[request.path_params["id"]]
    if served.model is None:
        raise ApiError(404, "no_model", "the map has no model; --model gives it one")
    return Response(served.model, media_type="application/json")


async def show_film(request: Request) -> Response:
    """`GET /v1/film`: a video that the page can play instead of a camera, also in parts."""
    film = service_of(request).options.film
    if film is None:
        raise ApiError(404, "no_film", "the server has no film")
    return FileResponse(film)


async def show_authority(request: Request) -> Response:
    """`GET /authority.crt`: the certificate that phones have to trust once."""
    path = service_of(request).options.authority
    if path is None:
        raise ApiError(404, "no_authority", "the server has no authority of its own")
    return FileResponse(path, media_type="application/x-x509-ca-cert", filename="slimsfm-authority.crt")


async def show_api(request: Request) -> Response:  # noqa: ARG001
    """`GET /openapi.json`."""
    return JSONResponse(OPENAPI)


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
