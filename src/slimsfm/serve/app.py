"""The application: which path is answered by what."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.routing import BaseRoute, Route, WebSocketRoute

from slimsfm.serve import handlers, page_files
from slimsfm.serve.guard import Guard, http_error
from slimsfm.serve.options import ServeOptions
from slimsfm.serve.service import Service
from slimsfm.serve.tracking import track

ROUTES: tuple[BaseRoute, ...] = (
    Route("/", page_files.index),
    Route("/page/{name}", page_files.named),
    Route("/healthz", handlers.healthz),
    Route("/metrics", handlers.metrics),
    Route("/v1/maps", handlers.list_maps),
    Route("/v1/maps/{id}", handlers.show_map),
    Route("/v1/maps/{id}/points", handlers.show_points),
    Route("/v1/maps/{id}/model", handlers.show_model),
    Route("/v1/film", handlers.show_film),
    Route("/authority.crt", handlers.show_authority),
    Route("/openapi.json", handlers.show_api),
    Route("/v1/localize", handlers.localize, methods=["POST"]),
    Route("/oscp/localize/geopose", handlers.localize_geopose, methods=["POST"]),
    WebSocketRoute("/v1/track", track),
)


def create_app(options: ServeOptions) -> Starlette:
    """Make an application that serves maps; any ASGI server can run it.

    Raises:
        InputError: A map cannot be read.
    """
    service = Service(options)

    @asynccontextmanager
    async def lifespan(_app: Starlette) -> AsyncIterator[None]:
        async with service.running():
            yield

    app = Starlette(
        routes=ROUTES,
        lifespan=lifespan,
        middleware=[Middleware(Guard, service=service)],
        exception_handlers={HTTPException: http_error},
    )
    app.state.service = service
    return app
