"""How the commands speak to the user."""

from rich.console import Console


def log(sentence: str) -> None:
    """Tell the user something that is not a result: on standard error."""
    Console(stderr=True, highlight=False).print(sentence, markup=False, soft_wrap=True)
