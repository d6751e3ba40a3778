"""What can go wrong for a user, as one tree.

    SlimsfmError            any failure that a user can mend; the command line prints it and exits with 2
    ├── InputError          a file, folder or argument given by the user cannot be used
    │   ├── ImageError      ... because an image cannot be read
    │   ├── ModelError      ... because a COLMAP model is damaged or lacks something
    │   └── MapError        ... because a map is damaged, incomplete or of a later format
    ├── OutputError         a result cannot be written where the user asked
    ├── ReconstructionError Structure from Motion found no model in the images
    └── WorkError           work given to other processes or machines failed again and again

A bad value in Python code is a plain `ValueError` that names the argument. An image that cannot be localized
is no error: its pose is None.
"""


class SlimsfmError(Exception):
    """A failure that its reader can mend; the message says what to do."""


class InputError(SlimsfmError):
    """A file, folder or argument given by the user cannot be used."""


class ImageError(InputError):
    """An image cannot be read."""


class ModelError(InputError):
    """A COLMAP model is damaged or lacks something that is needed."""


class MapError(InputError):
    """A map is damaged, incomplete or of a later format."""


class OutputError(SlimsfmError):
    """A result cannot be written where the user asked."""


class ReconstructionError(SlimsfmError):
    """Structure from Motion found no model in the images."""


class WorkError(SlimsfmError):
    """Work given to other processes or machines failed again and again."""
