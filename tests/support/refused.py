"""A user's mistake is answered by one sentence."""

from collections.abc import Callable
from typing import Any

import pytest

from anytouch_jax.errors import UserError


def refused(words: str, call: Callable[..., Any], *args: Any, **options: Any) -> str:
    """Return the sentence of the UserError that a call raises: one line in which the pattern
    `words` is found.
    """
    with pytest.raises(UserError, match=words) as error:
        call(*args, **options)
    assert "\n" not in str(error.value)
    return str(error.value)
