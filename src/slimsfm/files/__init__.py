"""Files: outputs that appear complete or not at all, and readers that trust no input."""

from slimsfm.files.atomic import check_writable, remove, replacing, uninterrupted
from slimsfm.files.contents import contents_of
from slimsfm.files.names import inside
from slimsfm.files.npz import read_npz, unpacked
from slimsfm.files.plain import plain
from slimsfm.files.text import read_bytes, read_json, read_text

__all__ = [
    "check_writable",
    "contents_of",
    "inside",
    "plain",
    "read_bytes",
    "read_json",
    "read_npz",
    "read_text",
    "remove",
    "replacing",
    "uninterrupted",
    "unpacked",
]
