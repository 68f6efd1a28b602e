"""Errors that a user can mend."""

_LETTERS = 500  # of a message


def shorten(text: str) -> str:
    """Return a message without its middle if it is long, as one that quotes a damaged file can be."""
    return text if len(text) <= _LETTERS else f"{text[:350]} ... {text[-140:]}"


class UserError(ValueError):
    """A user's mistake. The message is one sentence that says what is wrong, where, and what to do."""

    def __str__(self) -> str:
        return shorten(super().__str__())


class ConfigError(UserError):
    """A configuration that cannot be read or is inconsistent. The message says what to change."""


class CheckError(UserError):
    """A check that failed, such as an export that differs from its model. The command line exits with 1."""
