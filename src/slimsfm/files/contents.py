"""Anything unexpected inside a file becomes the error of that file."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from slimsfm.errors import InputError, SlimsfmError


@contextmanager
def contents_of(path: Path | str, advice: str, kind: type[InputError] = InputError) -> Iterator[None]:
    """Report whatever parsing the contents of a file raises as an error that names the file.

    The block only parses: libraries raise all kinds of errors for damaged contents.

    Args:
        path: The file, or what of it is parsed.
        advice: What to do, or what the file should hold.
        kind: Class of the error.

    Raises:
        InputError: The block raised an error; one that a user can fix already is raised as it is.
    """
    try:
        yield
    except SlimsfmError:
        raise
    except FileNotFoundError as error:
        raise kind(f"{path}: no such file") from error
    except Exception as error:
        raise kind(f"{path}: damaged or of another kind ({_reason(error)}); {advice}") from error


def _reason(error: Exception) -> str:
    if isinstance(error, KeyError):
        return f"without {error}"
    text = " ".join(str(error).split())
    return text or type(error).__name__
