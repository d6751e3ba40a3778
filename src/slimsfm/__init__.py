"""slimsfm: make a Structure-from-Motion model small and localizing in it fast, and know what that costs."""

# Before pycolmap, whose wheel exports the symbols of a zlib of its own: loaded first, they would stand in for
# half of the system's, and Python's zlib would then corrupt the heap.
import zlib as _zlib  # noqa: F401
