"""What the origin of a map says of changes: how many images were added or forgotten, over all changes."""

import re


def with_count(origin: str, count: int, what: str) -> str:
    """The origin of a map after a change: "..., 12 added" becomes "..., 15 added" with three more."""
    ending = re.compile(rf", (\d+) {re.escape(what)}$")
    before = ending.search(origin)
    total = count + (int(before[1]) if before else 0)
    rest = ending.sub("", origin)
    return f"{rest}, {total} {what}" if total else rest
