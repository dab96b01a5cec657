"""The one exception that means: this input is refused."""

from __future__ import annotations


class InputError(ValueError):
    """Input that CranioNav refuses; the message says what is wrong, where, and what to do.

    The command line prints it as one line and ends with exit status 2; a panel shows it beside the
    field. Every other exception is a defect of CranioNav itself.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(str(message).split()))
