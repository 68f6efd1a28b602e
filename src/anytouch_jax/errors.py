"""Errors that a user can mend."""


class UserError(ValueError):
    """A user's mistake. The message is one sentence that says what is wrong, where, and what to do."""


class ConfigError(UserError):
    """A configuration that cannot be read or is inconsistent. The message says what to change."""


class CheckError(UserError):
    """A check that failed, such as an export that differs from its model. The command line exits with 1."""
