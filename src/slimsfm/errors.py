"""Errors that a user can fix, as one tree of exceptions.

    SlimsfmError                any failure that a user can fix; the command line prints it and exits with 2
    ├── InputError              a file, folder or argument given by the user cannot be used
    │   ├── ImageError          ... because an image cannot be read
    │   ├── ModelError          ... because a COLMAP model is damaged or incomplete
    │   ├── MapError            ... because a map is damaged, incomplete or of a later format
    │   └── VideoError          ... to its end, because a video is damaged or cut off or changes its size
    ├── OutputError             a result cannot be written where the user asked
    │   └── OutputExistsError   ... because it exists and may not be overwritten
    ├── ReconstructionError     Structure from Motion found no model in the images
    ├── ServerError             a server of maps refused a request, or does not answer
    └── WorkError               a task on other processes or machines failed repeatedly

A bad value in Python code is a plain `ValueError` that names the argument. An image that cannot be localized
is not an error: its pose is None.
"""


class SlimsfmError(Exception):
    """A failure that the user can fix; the message says how."""


class InputError(SlimsfmError):
    """A file, folder or argument given by the user cannot be used."""


class ImageError(InputError):
    """An image cannot be read."""


class ModelError(InputError):
    """A COLMAP model is damaged or incomplete."""


class MapError(InputError):
    """A map is damaged, incomplete or of a later format."""


class VideoError(InputError):
    """A video cannot be read to its end: it is damaged or cut off, or its size changes."""


class OutputError(SlimsfmError):
    """A result cannot be written where the user asked."""


class OutputExistsError(OutputError):
    """The output exists and may not be overwritten."""


class ReconstructionError(SlimsfmError):
    """Structure from Motion found no model in the images."""


class WorkError(SlimsfmError):
    """A task on other processes or machines failed repeatedly."""


class ServerError(SlimsfmError):
    """A server of maps refused a request, or does not answer.

    Attributes:
        status: The status of HTTP; 0 if no answer came.
        code: What went wrong, in a word for programs; empty if no answer came.
    """

    def __init__(self, message: str, status: int = 0, code: str = "") -> None:
        super().__init__(message)
        self.status, self.code = status, code
