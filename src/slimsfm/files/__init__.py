"""Files: outputs that appear complete or not at all, and readers that trust no input."""

from slimsfm.files.atomic import check_writable, read_unchanged, remove, replacing
from slimsfm.files.contents import contents_of
from slimsfm.files.interruption import uninterrupted
from slimsfm.files.locks import locked
from slimsfm.files.names import inside
from slimsfm.files.npz import read_npz, unpacked
from slimsfm.files.plain import plain
from slimsfm.files.text import read_bytes, read_json, read_text
from slimsfm.files.working_folders import remove_abandoned, working_folder

__all__ = [
    "check_writable",
    "contents_of",
    "inside",
    "locked",
    "plain",
    "read_bytes",
    "read_json",
    "read_npz",
    "read_text",
    "read_unchanged",
    "remove",
    "remove_abandoned",
    "replacing",
    "uninterrupted",
    "unpacked",
    "working_folder",
]
