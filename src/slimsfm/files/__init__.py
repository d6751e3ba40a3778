"""Files: outputs that appear complete or not at all, and readers that trust no input."""

from slimsfm.files.atomic import check_writable, read_unchanged, remove, replacing
from slimsfm.files.interruption import uninterrupted
from slimsfm.files.locks import locked
from slimsfm.files.working_folders import remove_abandoned, working_folder

__all__ = [
    "check_writable",
    "locked",
    "read_unchanged",
    "remove",
    "remove_abandoned",
    "replacing",
    "uninterrupted",
    "working_folder",
]
