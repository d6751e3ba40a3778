"""Files: outputs that appear complete or not at all, and readers that trust no input."""

from slimsfm.files.atomic import check_writable, remove, replacing, uninterrupted

__all__ = ["check_writable", "remove", "replacing", "uninterrupted"]
