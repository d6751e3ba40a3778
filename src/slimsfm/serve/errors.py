"""Errors that a client gets as an answer: a status of HTTP and a code that programs can compare."""


class ApiError(Exception):
    """A request that is not answered; `str(error)` says why, to the client.

    Attributes:
        status: The status of HTTP.
        code: What went wrong, in a word for programs.
        retry_after_s: Seconds after which the same request may succeed; None if it never will.
    """

    def __init__(self, status: int, code: str, message: str, retry_after_s: float | None = None) -> None:
        super().__init__(message)
        self.status, self.code, self.retry_after_s = status, code, retry_after_s


def bad_request(code: str, message: str) -> ApiError:
    """The request itself is wrong (400)."""
    return ApiError(400, code, message)
