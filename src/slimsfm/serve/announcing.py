"""What a server says when it starts: its addresses, a QR code for phones, and how to trust it."""

from io import StringIO
from urllib.parse import urlsplit

import segno

from slimsfm.serve.running import MapServer


def announcement(server: MapServer) -> str:
    """Addresses and maps; beyond this machine also a QR code of the best address."""
    store = server.service.store
    maps = "; ".join(f"{key}: {store[key].localizer.map.describe()}" for key in store.ids)
    first, *others = server.urls
    lines = [f"{first} serves {', '.join(store.ids)}; Ctrl-C stops it", maps]
    if others:
        lines.append(f"also at {' '.join(others)}")
    if server.options.token:
        lines.append(qr_code(first))
        lines.append("the address holds the token: who has it may use the server")
    if server.certificate and server.certificate.authority:
        base = urlsplit(first)
        lines.append(
            f"phones trust it once they have the authority {server.certificate.authority}, also at "
            f"{base.scheme}://{base.netloc}/authority.crt"
        )
    if server.options.record:
        lines.append(f"{server.options.record}: images that clients send are kept here")
    return "\n".join(lines)


def qr_code(text: str) -> str:
    """A QR code in characters of a terminal."""
    drawn = StringIO()
    segno.make(text, micro=False).terminal(drawn, compact=True)
    return drawn.getvalue().rstrip("\n")
