"""Anything unexpected inside a file becomes the error of that file."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from slimsfm.errors import InputError, SlimsfmError


@contextmanager
def contents_of(path: Path, what: str, advice: str = "") -> Iterator[None]:
    """Report whatever parsing the contents of a file raises as an error that names the file.

    The block only parses: libraries raise all kinds of errors for damaged contents.

    Args:
        path: The file.
        what: What is wrong, such as "damaged" or "must hold 8 corners"; the reason is appended.
        advice: What to do.

    Raises:
        InputError: The block raised an error.
        SlimsfmError: The block raised this, with or without the name of the file.
    """
    try:
        yield
    except SlimsfmError as error:
        if str(path) in str(error):
            raise
        raise type(error)(f"{path}: {error}") from error
    except Exception as error:
        raise InputError(f"{path}: {what} ({_reason(error)}){'; ' * bool(advice)}{advice}") from error


def _reason(error: Exception) -> str:
    if isinstance(error, KeyError):
        return f"without {error}"
    if isinstance(error, FileNotFoundError):
        return "there is no such file"
    text = " ".join(str(error).split())
    return text or type(error).__name__
