import io
import sys

from anytouch_jax.train.progress import chart, progress, to_stderr


class Terminal(io.StringIO):
    def isatty(self):
        return True


def row(step, **more):
    return {"step": step, "loss": 0.5, "samples_per_second": 30.4, "skipped_batches": 0} | more


def test_a_terminal_shows_a_bar_and_sentences_above_it(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    screen = sys.stderr
    with progress(0, 3, to_stderr) as advance:
        to_stderr("saved at step 1")
        for step in range(3):
            advance(row(step))
    shown = screen.getvalue()
    assert "3/3" in shown and "loss 0.5000" in shown and "saved at step 1" in shown


def test_the_curve_falls_with_the_loss():
    lines = chart([8.0] * 50 + [1.0] * 50, width=10, height=4).splitlines()
    assert [line[10:] for line in lines] == ["█████     "] * 3 + ["█████▁▁▁▁▁"]
    assert lines[0].startswith("   8.0000 ") and lines[-1].startswith("   1.0000 ")
    assert len(set(chart([2.0, 2.0]).splitlines()[-1][10:])) == 1  # no change, no division by zero


def test_elsewhere_some_twenty_lines_are_said():
    said = []
    with progress(100, 1100, said.append) as advance:
        for step in range(100, 1100):
            advance(row(step))
    assert len(said) == 21
    assert said[0] == "step 101/1100  loss 0.5000  30 samples/s" and said[-1].startswith("step 1100/1100")
