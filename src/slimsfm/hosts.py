"""Names of hosts in headers of requests: which of them are this machine."""

from ipaddress import ip_address
from urllib.parse import urlsplit


def host_of(origin: str) -> str:
    """Host and port of the header Origin, in lower case; empty if it has none."""
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""


def is_this_machine(host: str) -> bool:
    """Whether the header Host names this machine, with or without a port."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
        return name == "localhost" or ip_address(name).is_loopback
    except ValueError:
        return False
