"""`/v1/track`: sessions over WebSocket. Of the frames that wait for a worker, each client has the newest."""

import asyncio
import hmac
import json
import secrets
from collections.abc import Coroutine
from contextlib import suppress
from time import perf_counter
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from slimsfm.serve.errors import ApiError
from slimsfm.serve.messages import Frame, Hello, error_message, parse_frame, parse_hello
from slimsfm.serve.replies import Json
from slimsfm.serve.service import Service
from slimsfm.serve.session import TrackingSession

_CLOSE_CODES = {400: 4400, 401: 4401, 404: 4404, 408: 4408, 429: 4429}
_BAD_MESSAGE, _SHUTDOWN, _INTERNAL = 4400, 1001, 1011
_HELLO_S, _SEND_S = 5.0, 10.0


async def track(socket: WebSocket) -> None:
    """Answer a client until it leaves, is idle, sends what is no frame, or the server stops."""
    service: Service = socket.app.state.service
    await socket.accept()
    try:
        await _Connection(socket, service).serve()
    except ApiError as error:
        code = _CLOSE_CODES.get(error.status, _BAD_MESSAGE)
        await _ended(socket, code, error)
    except WebSocketDisconnect:
        pass
    except TimeoutError:
        await _ended(socket, 4408, ApiError(408, "slow", f"no answer was read for {_SEND_S:g} s"))
    except Exception:
        await _ended(socket, _INTERNAL, ApiError(500, "internal", "the server failed; its log says how"))
        raise


async def _ended(socket: WebSocket, code: int, error: ApiError) -> None:
    with suppress(Exception):
        async with asyncio.timeout(_SEND_S):
            await socket.send_text(json.dumps(error_message(error)))
            await socket.close(code, error.code)


class _Connection:
    """One client: what it sends, and what it gets."""

    def __init__(self, socket: WebSocket, service: Service) -> None:
        self._socket, self._service = socket, service
        self._client = socket.client.host if socket.client else ""
        self._id = secrets.token_hex(8)
        self._newest: tuple[Frame, float] | None = None
        self._arrived = asyncio.Event()
        self._dropped = 0
        self._session: TrackingSession | None = None

    async def serve(self) -> None:
        """Wait for the hello, then answer frames.

        Raises:
            ApiError: Why the session ends.
            WebSocketDisconnect: The client left.
        """
        with self._service.sessions.admitted(self._client, self._arrived):
            await self._welcome(await self._hello())
            await _first_of(self._receive(), self._answer())
            await self._socket.close(_SHUTDOWN, "the server stops")

    async def _hello(self) -> Hello:
        try:
            async with asyncio.timeout(_HELLO_S):
                message = await self._socket.receive()
        except TimeoutError as error:
            raise ApiError(408, "idle", f"no hello came within {_HELLO_S:g} s") from error
        _check_connected(message)
        return self._allowed(parse_hello(message.get("text") or ""))

    def _allowed(self, hello: Hello) -> Hello:
        """Check the token; it may have come as a header, which was checked already."""
        token = self._service.options.token
        by_header = self._socket.scope.get("slimsfm.authorized", False)
        if token and not by_header and not hmac.compare_digest(hello.token.encode(), token.encode()):
            raise ApiError(401, "bad_token", "the hello must have the token that slimsfm serve printed")
        return hello

    async def _welcome(self, hello: Hello) -> None:
        self._session = TrackingSession(self._service.store, hello, self._service.options.tracker)
        maps = [{"id": one.id, "version": one.version} for one in self._session.maps]
        await self._send({"type": "welcome", "session": self._id, "maps": maps})

    async def _receive(self) -> None:
        """Keep the newest frame; a further hello restarts tracking."""
        idle_s = self._service.options.limits.idle_s
        while True:
            try:
                async with asyncio.timeout(idle_s):
                    message = await self._socket.receive()
            except TimeoutError as error:
                raise ApiError(408, "idle", f"no frame came within {idle_s:g} s") from error
            _check_connected(message)
            if message.get("text") is not None:
                await self._welcome(self._allowed(parse_hello(message["text"])))
                continue
            if self._newest is not None:
                self._dropped += 1
            self._newest = parse_frame(message.get("bytes") or b""), perf_counter()
            self._arrived.set()

    async def _answer(self) -> None:
        """Answer the newest frame again and again, until the server stops."""
        while not self._service.sessions.ended:
            await self._arrived.wait()
            self._arrived.clear()
            if self._newest is None or self._session is None:
                continue
            (frame, since), self._newest = self._newest, None
            dropped, self._dropped = self._dropped, 0
            await self._send({**await self._tracked(self._session, frame, since), "dropped": dropped})

    async def _tracked(self, session: TrackingSession, frame: Frame, since: float) -> Json:
        begun = since

        def work() -> Json:
            nonlocal begun
            begun = perf_counter()
            return session.track(frame)

        service = self._service
        reply = await service.pool.run(self._id, "track", work)
        now = perf_counter()
        wait_ms, total_ms = round(1e3 * (begun - since), 3), round(1e3 * (now - since), 3)
        service.metrics.count("frames_total", map=reply["map"], state=reply["state"])
        service.metrics.observe("frame_seconds", now - since)
        service.recorder.keep_frame(self._id, frame.jpeg, reply)
        return {**reply, "ms": {**reply["ms"], "wait": wait_ms, "total": total_ms}}

    async def _send(self, message: Json) -> None:
        async with asyncio.timeout(_SEND_S):
            await self._socket.send_text(json.dumps(message, allow_nan=False, separators=(",", ":")))


def _check_connected(message: Any) -> None:
    if message["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(message.get("code", 1006))


async def _first_of(*coroutines: Coroutine) -> None:
    """Run until one ends, and raise its error; the others are cancelled and waited for."""
    tasks = [asyncio.ensure_future(one) for one in coroutines]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
