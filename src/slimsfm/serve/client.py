"""Ask a server of maps for poses, from Python: at once or with `await`. Needs httpx."""

import asyncio
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from ssl import SSLContext, create_default_context
from types import ModuleType
from typing import Any

import pycolmap

from slimsfm.errors import InputError, ServerError
from slimsfm.pose import Gravity
from slimsfm.serve.remote import (
    TRIES,
    Address,
    GivenCamera,
    Picture,
    RemoteLocalization,
    answer_of,
    file_of,
    localization_of,
    parameters_of,
    pause_s,
)


class Client:
    """A server of maps. Close it, or use it in a `with` statement. May be used by several threads."""

    def __init__(
        self, url: str, *, token: str = "", verify: str | Path | bool = True, timeout_s: float = 30.0
    ) -> None:
        """Prepare to connect.

        Args:
            url: Address that `slimsfm serve` printed, with the token in its fragment or without.
            token: The token, if the address does not hold it.
            verify: Certificate of the authority to trust (`authority.pem`); False trusts any server.
            timeout_s: Seconds to wait for an answer.

        Raises:
            InputError: The address or the certificate cannot be used, or httpx is missing.
        """
        self._client = _httpx().Client(**_settings(url, token, verify, timeout_s))

    def localize(
        self,
        image: Picture,
        *,
        maps: Sequence[str] = (),
        camera: GivenCamera = None,
        prior_cam_from_world: pycolmap.Rigid3d | None = None,
        gravity: Gravity | None = None,
    ) -> RemoteLocalization:
        """Localize one image.

        Args:
            image: The image, see `Picture`.
            maps: Ids of the maps to search; all by default.
            camera: The intrinsics, see `GivenCamera`.
            prior_cam_from_world: About where the camera is.
            gravity: Direction of gravity in the map and in the camera.

        Raises:
            ServerError: The server refuses or does not answer.
            ImageError: The image cannot be read.
        """
        params = parameters_of(maps, camera, prior_cam_from_world, gravity)
        return localization_of(self._send("POST", "v1/localize", params=params, content=file_of(image)))

    def maps(self) -> list[dict[str, Any]]:
        """What the server says of its maps: id, version, unit, box and more.

        Raises:
            ServerError: The server refuses or does not answer.
        """
        return self._send("GET", "v1/maps")["maps"]

    def _send(self, method: str, path: str, **more: Any) -> dict[str, Any]:
        left = TRIES
        while True:
            left -= 1
            with _reporting():
                response = self._client.request(method, path, **more)
            pause = pause_s(response.status_code, response.headers.get("retry-after", ""), left)
            if pause is None:
                return answer_of(response.status_code, _content(response))
            time.sleep(pause)

    def close(self) -> None:
        """Close the connections."""
        self._client.close()

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class AsyncClient:
    """`Client` for asyncio: the same with `await` and `async with`."""

    def __init__(
        self, url: str, *, token: str = "", verify: str | Path | bool = True, timeout_s: float = 30.0
    ) -> None:
        """Prepare to connect, as `Client` does."""
        self._client = _httpx().AsyncClient(**_settings(url, token, verify, timeout_s))

    async def localize(
        self,
        image: Picture,
        *,
        maps: Sequence[str] = (),
        camera: GivenCamera = None,
        prior_cam_from_world: pycolmap.Rigid3d | None = None,
        gravity: Gravity | None = None,
    ) -> RemoteLocalization:
        """Localize one image, see `Client.localize`."""
        params = parameters_of(maps, camera, prior_cam_from_world, gravity)
        return localization_of(await self._send("POST", "v1/localize", params=params, content=file_of(image)))

    async def maps(self) -> list[dict[str, Any]]:
        """What the server says of its maps, see `Client.maps`."""
        return (await self._send("GET", "v1/maps"))["maps"]

    async def _send(self, method: str, path: str, **more: Any) -> dict[str, Any]:
        left = TRIES
        while True:
            left -= 1
            with _reporting():
                response = await self._client.request(method, path, **more)
            pause = pause_s(response.status_code, response.headers.get("retry-after", ""), left)
            if pause is None:
                return answer_of(response.status_code, _content(response))
            await asyncio.sleep(pause)

    async def close(self) -> None:
        """Close the connections."""
        await self._client.aclose()

    async def __aenter__(self) -> "AsyncClient":
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()


def _httpx() -> ModuleType:
    try:
        import httpx
    except ImportError as error:
        raise InputError("the client needs httpx: pip install 'slimsfm[serve]'") from error
    return httpx


def _settings(url: str, token: str, verify: str | Path | bool, timeout_s: float) -> dict[str, Any]:
    address = Address.of(url, token)
    headers = {"Authorization": f"Bearer {address.token}"} if address.token else {}
    trusted: SSLContext | bool = verify if isinstance(verify, bool) else _trusting(Path(verify))
    return {"base_url": address.url, "headers": headers, "verify": trusted, "timeout": timeout_s}


def _trusting(authority: Path) -> SSLContext:
    try:
        return create_default_context(cafile=authority)
    except OSError as error:
        raise InputError(f"{authority}: not a readable certificate ({error})") from error


def _content(response: Any) -> Any:
    try:
        return response.json()
    except ValueError:
        return None


@contextmanager
def _reporting() -> Iterator[None]:
    """Report that the server does not answer."""
    import httpx

    try:
        yield
    except httpx.HTTPError as error:
        raise ServerError(f"the server does not answer: {str(error) or type(error).__name__}") from error
