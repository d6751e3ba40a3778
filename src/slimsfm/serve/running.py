"""Run the application: address, certificate and token, start and stop."""

import asyncio
import ctypes
import logging
import secrets
import socket
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import uvicorn

from slimsfm.errors import InputError
from slimsfm.serve.addresses import Listening, listen, url_host
from slimsfm.serve.app import create_app
from slimsfm.serve.certificates import Certificate, certificate_for
from slimsfm.serve.connections import TimedProtocol
from slimsfm.serve.options import ServeOptions
from slimsfm.serve.service import Service

_STOP_S = 15
_M_ARENA_MAX = -8  # of glibc's mallopt
_MAX_HEADERS = 16 * 2**10
_KEEP_ALIVE_S = 10


@dataclass(frozen=True, kw_only=True)
class Binding:
    """Where a server listens."""

    host: str = "localhost"
    """Name or address: localhost serves this machine only, 0.0.0.0 the whole network."""

    port: int = 8000
    """Port; 0 picks a free one."""

    cert: Path | None = None
    """Certificate for HTTPS, PEM. By default one is made where others than this machine are served."""

    key: Path | None = None
    """Private key of the certificate, PEM."""

    authority: Path | None = None
    """Folder of the authority that makes certificates; by default in the user's data folder."""


class MapServer:
    """A server of maps, ready to run.

    Attributes:
        options: What is served, with the token that requests must carry.
        urls: Addresses of the page, the best first; the token is in the fragment, which is not sent.
        certificate: Certificate for HTTPS; None for HTTP.
        service: What the handlers share.
    """

    def __init__(self, options: ServeOptions, binding: Binding = Binding()) -> None:
        """Read the maps and open the port.

        Raises:
            InputError: A map, the certificate or the port cannot be used.
        """
        if (binding.cert is None) != (binding.key is None):
            raise InputError("cert: a certificate and its key go together; give `cert=FILE` and `key=FILE`")
        listening = listen(binding.host, binding.port)
        try:
            self.certificate = _certificate(binding, listening)
            if not options.token and not listening.is_local:
                options = replace(options, token=secrets.token_urlsafe(16))
            if self.certificate and self.certificate.authority:
                options = replace(options, authority=self.certificate.authority)
            self.options = options
            app = create_app(options)
        except BaseException:
            listening.socket.close()
            raise
        self.service: Service = app.state.service
        self.urls = _urls(listening, options.token, is_secure=self.certificate is not None)
        self._socket = listening.socket
        self._server = _Server(self._config(app), self.service)

    def run(self, started: Callable[[], None] = lambda: None) -> None:
        """Serve until SIGINT, SIGTERM or `stop`; then finish what runs.

        Args:
            started: Called when requests are answered.
        """
        self._server.started_ = started
        try:
            asyncio.run(self._server.serve(sockets=[self._socket]))
        finally:
            self._socket.close()

    def close(self) -> None:
        """Release the port and the workers of a server that was never run."""
        self._socket.close()
        self.service.pool.close()

    def stop(self) -> None:
        """Let `run`, on another thread, finish what runs and return."""
        self._server.should_exit = True

    def _config(self, app: Callable) -> uvicorn.Config:
        found, limits = self.certificate, self.options.limits
        return uvicorn.Config(
            app,
            http=TimedProtocol,
            ws="websockets-sansio",
            ws_max_size=limits.max_body_bytes,
            ws_per_message_deflate=False,
            h11_max_incomplete_event_size=_MAX_HEADERS,
            timeout_keep_alive=_KEEP_ALIVE_S,
            timeout_graceful_shutdown=_STOP_S,
            ssl_certfile=found and found.chain,
            ssl_keyfile=found and found.key,
            access_log=False,
            log_config=None,
            server_header=False,
            proxy_headers=False,
        )


class _Server(uvicorn.Server):
    """uvicorn's server, which ends sessions before connections."""

    def __init__(self, config: uvicorn.Config, service: Service) -> None:
        super().__init__(config)
        self._service = service
        self.started_: Callable[[], None] = lambda: None

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        self.started_()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        for server in self.servers:
            server.close()
        self._service.sessions.end()
        for _ in range(100 * _STOP_S):
            if not self._service.sessions.count:
                break
            await asyncio.sleep(0.01)
        await super().shutdown(sockets)


def _certificate(binding: Binding, listening: Listening) -> Certificate | None:
    if binding.cert and binding.key:
        for path in (binding.cert, binding.key):
            if not path.is_file():
                raise InputError(f"{path}: no such file")
        return Certificate(chain=binding.cert, key=binding.key)
    return None if listening.is_local else certificate_for(listening.hosts, binding.authority)


def _urls(listening: Listening, token: str, *, is_secure: bool) -> tuple[str, ...]:
    scheme, fragment = "https" if is_secure else "http", f"#token={token}" if token else ""
    return tuple(f"{scheme}://{url_host(host)}:{listening.port}/{fragment}" for host in listening.hosts)


def silence_uvicorn() -> None:
    """Let uvicorn log what went wrong, and nothing else."""
    for name in ("uvicorn", "uvicorn.error"):
        logging.getLogger(name).setLevel(logging.ERROR)


def use_few_arenas() -> None:
    """Let all threads share two heaps, where the C library is glibc.

    By default it gives threads heaps of their own, which only grow: after a minute of mixed traffic, a server
    had 630 MB instead of 395.
    """
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 2)
