"""Bodies of requests: counted while they come, cut at the limit, and not waited for forever."""

import asyncio
from contextlib import suppress

from starlette.requests import ClientDisconnect, Request
from starlette.types import Receive, Scope

from slimsfm.serve.errors import ApiError, bad_request
from slimsfm.serve.options import ServeLimits

BODY_READ = "slimsfm.body_read"
"""Key of a request's scope: whether its body was read to the end."""

_DRAIN_S = 1.0


async def read_body(request: Request, limits: ServeLimits) -> bytes:
    """The body of a request.

    Raises:
        ApiError: It is too large (413), too slow (408), empty, or the connection broke (400).
    """
    announced = request.headers.get("content-length", "0")
    if announced.isdigit() and int(announced) > limits.max_body_bytes:
        raise _too_large(limits)
    body = bytearray()
    try:
        async with asyncio.timeout(limits.receive_s):
            async for chunk in request.stream():
                body += chunk
                if len(body) > limits.max_body_bytes:
                    raise _too_large(limits)
    except TimeoutError as error:
        raise ApiError(408, "too_slow", f"the body took longer than {limits.receive_s:g} s") from error
    except ClientDisconnect as error:
        raise bad_request("incomplete_body", "the connection broke before the body was complete") from error
    request.scope[BODY_READ] = True
    if not body:
        raise bad_request("empty_body", "the body must be an image file")
    return bytes(body)


async def drain(scope: Scope, receive: Receive, limits: ServeLimits) -> None:
    """Read what is left of a body that nobody needs, a second at most, so that its sender reads the answer.

    A connection that is closed while data wait to be read is reset, and the answer is lost with it.
    """
    is_asking = any(name == b"expect" for name, _ in scope["headers"])  # whether to send the body at all
    if scope["method"] != "POST" or scope.get(BODY_READ) or is_asking:
        return
    left, more = 2 * limits.max_body_bytes, True  # a body that is a little too large is read to its end
    with suppress(TimeoutError):
        async with asyncio.timeout(_DRAIN_S):
            while more and left > 0:
                message = await receive()
                left -= len(message.get("body", b""))
                more = message.get("more_body", False)
    scope[BODY_READ] = not more


def _too_large(limits: ServeLimits) -> ApiError:
    return ApiError(413, "body_too_large", f"the body may have {limits.max_body_bytes // 2**20} MiB at most")
