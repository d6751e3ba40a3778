"""The gate of a server: which requests reach it, and what every answer carries."""

import hmac
import logging
import re
import secrets
from dataclasses import dataclass
from time import perf_counter

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from slimsfm.hosts import host_of, is_this_machine
from slimsfm.serve.bodies import BODY_READ, drain
from slimsfm.serve.errors import ApiError
from slimsfm.serve.service import Service

_LOGGER = logging.getLogger(__name__)
_GUARDED = "/v1/", "/oscp/", "/metrics"
_HOST = re.compile(r"[A-Za-z0-9._:\[\]-]{1,255}")
_FIXED_HEADERS = {
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "permissions-policy": "camera=(self), accelerometer=(self), gyroscope=(self), magnetometer=(self), "
    "geolocation=(), microphone=()",
}
_CODES = {404: "not_found", 405: "method_not_allowed"}


@dataclass(frozen=True, kw_only=True)
class _Asked:
    """A request as far as the gate looks at it."""

    id: str
    headers: Headers
    host: str
    origin: str | None


class Guard:
    """Wraps an application: checks host, origin and token, turns errors into answers, and counts."""

    def __init__(self, app: ASGIApp, service: Service) -> None:
        self._app, self._service = app, service
        self._in_flight = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request or open a WebSocket."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        hosts = headers.getlist("host")
        origins = headers.getlist("origin")
        asked = _Asked(
            id=secrets.token_hex(8),
            headers=headers,
            host=hosts[0] if len(hosts) == 1 else "",
            origin=origins[0] if len(origins) == 1 else ",".join(origins) or None,
        )
        if scope["type"] == "websocket":
            await self._open(asked, scope, receive, send)
        else:
            await self._answer(asked, scope, receive, send)

    async def _open(self, asked: _Asked, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            self._check_source(asked)
            scope["slimsfm.authorized"] = self._has_token(asked)
        except ApiError as error:
            await error_response(error, asked.id)(scope, receive, send)
            return
        await self._app(scope, receive, send)

    async def _answer(self, asked: _Asked, scope: Scope, receive: Receive, send: Send) -> None:
        start, status, service = perf_counter(), 500, self._service

        async def send_with_headers(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                answer = MutableHeaders(scope=message)
                self._add_headers(asked, answer)
                if status >= 400 and scope["method"] == "POST" and not scope.get(BODY_READ):
                    answer["connection"] = "close"  # what is left of the body is not read
            await send(message)

        self._in_flight += 1
        scope["slimsfm.request_id"] = asked.id
        try:
            response = await self._admit(asked, scope)
            if response is None:
                await self._app(scope, receive, send_with_headers)
            else:
                await response(scope, receive, send_with_headers)
        except ApiError as error:
            service.metrics.count("refused_total", code=error.code)
            await drain(scope, receive, service.options.limits)
            await error_response(error, asked.id)(scope, receive, send_with_headers)
        except Exception:
            _LOGGER.exception("request %s failed", asked.id)
            failed = ApiError(500, "internal", "the server failed; its log says how")
            await error_response(failed, asked.id)(scope, receive, send_with_headers)
        finally:
            self._in_flight -= 1
            route = scope.get("route")
            service.metrics.count("requests_total", route=getattr(route, "path", "none"), status=status)
            service.metrics.observe("request_seconds", perf_counter() - start)

    async def _admit(self, asked: _Asked, scope: Scope) -> Response | None:
        """Check a request; a response if it needs no handler.

        Raises:
            ApiError: It is refused.
        """
        self._check_source(asked)
        if self._in_flight > self._service.options.limits.max_requests:
            raise ApiError(503, "overloaded", "too many requests at once; try again later", 1.0)
        if scope["method"] == "OPTIONS" and asked.origin in self._service.options.origins:
            return Response(status_code=204)
        if scope["path"].startswith(_GUARDED) and not self._has_token(asked):
            raise ApiError(
                401, "bad_token", "send the token that slimsfm serve printed: Authorization: Bearer"
            )
        return None

    def _check_source(self, asked: _Asked) -> None:
        options = self._service.options
        if not _HOST.fullmatch(asked.host):
            raise ApiError(400, "bad_host", "there must be one header Host with the name of a host")
        if not options.token and not is_this_machine(asked.host):
            raise ApiError(403, "bad_host", "the host must be this machine")
        is_own = asked.origin is None or host_of(asked.origin) == asked.host.lower()
        if not is_own and asked.origin not in options.origins:
            raise ApiError(
                403, "bad_origin", "only the server's own page may connect; --origins names others"
            )

    def _has_token(self, asked: _Asked) -> bool:
        token, given = self._service.options.token, asked.headers.getlist("authorization")
        if not token:
            return True
        scheme, _, value = (given[0] if len(given) == 1 else "").partition(" ")
        return scheme.lower() == "bearer" and hmac.compare_digest(value.strip().encode(), token.encode())

    def _add_headers(self, asked: _Asked, headers: MutableHeaders) -> None:
        headers.update(_FIXED_HEADERS)
        headers["x-request-id"] = asked.id
        headers["content-security-policy"] = content_security_policy(asked.host)
        headers.setdefault("cache-control", "no-store")
        if asked.origin and asked.origin in self._service.options.origins:
            headers["access-control-allow-origin"] = asked.origin
            headers["access-control-allow-headers"] = "Authorization, Content-Type"
            headers["access-control-allow-methods"] = "GET, POST"
            headers["access-control-expose-headers"] = "X-Request-Id, Retry-After"
        if self._service.options.origins:
            headers["vary"] = "Origin"


def content_security_policy(host: str) -> str:
    """The policy of every answer: nothing from anywhere but this server, no inline script or style."""
    sockets = f" ws://{host} wss://{host}" if _HOST.fullmatch(host) else ""
    return (
        f"default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
        f"media-src 'self' blob:; connect-src 'self'{sockets}; worker-src 'self'; manifest-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


def error_response(error: ApiError, request_id: str) -> JSONResponse:
    """An error as the answer to a request."""
    body = {"error": {"code": error.code, "message": str(error)}, "request_id": request_id}
    headers = {}
    if error.retry_after_s is not None:
        headers["retry-after"] = str(max(1, round(error.retry_after_s + 0.5)))
    if error.status == 401:
        headers["www-authenticate"] = "Bearer"
    return JSONResponse(body, error.status, headers)


async def http_error(request: Request, error: Exception) -> Response:
    """An error of the router, such as an unknown path, as an answer."""
    status, detail = (error.status_code, error.detail) if isinstance(error, HTTPException) else (500, "")
    known = ApiError(status, _CODES.get(status, "http_error"), detail)
    return error_response(known, request.scope["slimsfm.request_id"])
