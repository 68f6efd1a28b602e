import io
import sys
import time

import pytest

from anytouch_jax import progress as bars


class Terminal(io.StringIO):
    def isatty(self):
        return True


def screen_of(monkeypatch):
    """Let the error stream be a terminal, from within a test: pytest replaces it between the phases
    of one.
    """
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    return sys.stderr


def test_a_terminal_shows_a_bar_with_the_time_left_and_an_error_takes_it_away(monkeypatch):
    screen = screen_of(monkeypatch)
    monkeypatch.setattr(bars, "WAIT", 0.0)
    assert list(bars.tracked("abc", "letters")) == ["a", "b", "c"]
    assert (
        "letters" in screen.getvalue()
        and "3/3" in screen.getvalue()
        and "0:00:00" in screen.getvalue()
    )
    with pytest.raises(ZeroDivisionError), bars.bar(2, "steps") as advance:
        advance(1)
        raise ZeroDivisionError
    assert screen.getvalue().endswith("\x1b[?25h")  # the cursor is back


def test_short_work_shows_nothing_and_elsewhere_nothing_is_shown(monkeypatch):
    screen = screen_of(monkeypatch)
    assert (
        list(bars.tracked("abc", "letters")) == ["a", "b", "c"]
        and "letters" not in screen.getvalue()
    )
    monkeypatch.setattr(sys, "stderr", io.StringIO())  # no terminal
    monkeypatch.setattr(bars, "WAIT", 0.0)
    assert (
        list(bars.tracked(iter("abc"), "letters")) == ["a", "b", "c"]
        and sys.stderr.getvalue() == ""
    )


def test_a_long_first_item_has_a_bar_and_a_bar_inside_goes_when_it_is_done(monkeypatch):
    screen = screen_of(monkeypatch)
    monkeypatch.setattr(bars, "WAIT", 0.01)
    # never moved
    with bars.bar(1, "folders"):
        assert list(bars.tracked("ab", "frames")) == ["a", "b"]
        while "folders" not in screen.getvalue():
            time.sleep(0.01)
    assert bars._display is None
