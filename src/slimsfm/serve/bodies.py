"""Bodies of requests: counted while they come, cut at the limit, and not waited for forever."""

import asyncio

from starlette.requests import ClientDisconnect, Request

from slimsfm.serve.errors import ApiError, bad_request
from slimsfm.serve.options import ServeLimits


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
    request.scope["slimsfm.body_read"] = True
    if not body:
        raise bad_request("empty_body", "the body must be an image file")
    return bytes(body)


def _too_large(limits: ServeLimits) -> ApiError:
    return ApiError(413, "body_too_large", f"the body may have {limits.max_body_bytes // 2**20} MiB at most")
