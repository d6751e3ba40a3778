"""Who may connect to the live view: its own page, and beyond this machine only who knows its token.

A page of any site can open a WebSocket to an address that its visitor's browser reaches, such as a server on
the same machine. Browsers say in the header Origin which page it is.
"""

import hmac
import http
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from ipaddress import ip_address
from threading import Lock
from typing import Any

from websockets.asyncio import server as websockets_server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from slimsfm.errors import InputError
from slimsfm.hosts import host_of, is_this_machine

Answer = Callable[[Any, Request], Response | None]
"""Takes a connection and a request; returns the response, or None to open a WebSocket."""

_serving = Lock()


@dataclass(frozen=True, kw_only=True)
class Access:
    """The requests that a server answers."""

    token: str = ""
    """First part of the path of every request. Empty for a server that only this machine reaches: its
    requests must name this machine as the host, which those of a foreign domain that points here do not."""

    @classmethod
    def to(cls, address: str) -> "Access":
        """Access to a server at an IP address: with a new token unless only this machine reaches it."""
        return cls(token="" if ip_address(address).is_loopback else secrets.token_urlsafe(16))

    def refusal(self, request: Request) -> str | None:
        """Why a request is refused; None if it is not."""
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        if len(hosts) != 1 or not (self.token or is_this_machine(hosts[0])):
            return "the host must be this machine"
        if any(host_of(origin) != hosts[0].lower() for origin in origins):
            return "only the page of the view itself may connect"
        first = request.path.partition("?")[0].split("/")[1:2]
        if self.token and not hmac.compare_digest("".join(first).encode(), self.token.encode()):
            return "the address must hold the token that slimsfm view printed"
        return None

    def guarded(self, answer: Answer) -> Answer:
        """Refuse requests before they are answered, and remove the token from the path of the others."""

        def answer_allowed(connection: Any, request: Request) -> Response | None:
            why = self.refusal(request)
            if why is None:
                path = request.path.removeprefix(f"/{self.token}") if self.token else request.path
                return answer(connection, replace(request, path=path or "/"))
            body = f"403: {why}\n".encode()
            headers = Headers({"Content-Type": "text/plain", "Content-Length": str(len(body))})
            return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", headers, body)

        return answer_allowed


@contextmanager
def serving(access: Access) -> Iterator[None]:
    """Guard the server that viser starts in this context. viser itself has no option for it.

    Raises:
        InputError: viser started no server in the way that is known.
    """
    plain, guarded = websockets_server.serve, []

    def serve(*arguments: Any, process_request: Answer, **options: Any) -> Any:
        guarded.append(True)
        return plain(*arguments, process_request=access.guarded(process_request), **options)

    with _serving:
        websockets_server.serve = serve
        try:
            yield
        finally:
            websockets_server.serve = plain
    if not guarded:
        raise InputError("this viser cannot be kept from answering foreign pages; install viser 1.1")
