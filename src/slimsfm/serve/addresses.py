"""The addresses of this machine, and a socket at one of them."""

import socket
from dataclasses import dataclass
from ipaddress import ip_address

from slimsfm.errors import InputError

_ELSEWHERE = (socket.AF_INET, "192.0.2.1"), (socket.AF_INET6, "2001:db8::1")  # nothing is sent to them


@dataclass(frozen=True, kw_only=True)
class Listening:
    """A socket that waits for connections, and where others find it."""

    socket: socket.socket
    hosts: tuple[str, ...]
    is_local: bool

    @property
    def port(self) -> int:
        """The port."""
        return self.socket.getsockname()[1]


def listen(host: str, port: int) -> Listening:
    """Open a socket at a host's address.

    Args:
        host: A name or address; 0.0.0.0 is every address of this machine.
        port: 0 picks a free one.

    Raises:
        InputError: The host is unknown or the port is not available.
    """
    if not 0 <= port < 2**16:
        raise InputError(f"port must be between 0 and 65535, got {port}")
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        family, *_, address = min(found, key=lambda one: one[0] != socket.AF_INET)
        opened = socket.create_server(address[:2], family=family, backlog=128)
    except OSError as error:
        raise InputError(
            f"port {port} of {host} cannot be served ({error.strerror}); choose another port or host"
        ) from error
    parsed = ip_address(address[0])
    hosts = tuple(machine_addresses()) if parsed.is_unspecified else (host,)
    return Listening(socket=opened, hosts=hosts or ("localhost",), is_local=parsed.is_loopback)


def machine_addresses() -> list[str]:
    """The addresses that others may reach this machine by, the most likely first."""
    found = [address for family, elsewhere in _ELSEWHERE if (address := _address_towards(family, elsewhere))]
    try:
        named = socket.getaddrinfo(socket.gethostname(), None, type=socket.SOCK_STREAM)
        found += [str(one[4][0]) for one in named]
    except OSError:
        pass
    return [one for one in dict.fromkeys(found) if not _is_useless(one)]


def _address_towards(family: int, elsewhere: str) -> str | None:
    """The address that packets to elsewhere would leave from; none is sent."""
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect((elsewhere, 9))
            return probe.getsockname()[0]
    except OSError:
        return None


def _is_useless(address: str) -> bool:
    parsed = ip_address(address.partition("%")[0])
    return parsed.is_loopback or parsed.is_link_local or parsed.is_unspecified


def url_host(host: str) -> str:
    """A host as URLs have it: addresses with colons in brackets."""
    return f"[{host}]" if ":" in host else host
