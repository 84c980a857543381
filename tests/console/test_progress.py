"""What is shown on a terminal beside results: lines and bars, whatever names are in them."""

import io

import pytest
from rich.console import Console

from experiments.console import progress as terminal
from experiments.console.progress import progress, say, tracked

AWKWARD = "$x$|a\nb\x1b[31m[red]\u202e<script>"
SPELLED = r"$x$|a\nb\x1b[31m[red]\u202e<script>"


@pytest.fixture
def screen(monkeypatch):
    """A terminal of 100 columns that standard error goes to."""
    shown = io.StringIO()

    def console(**_):
        return Console(file=shown, force_terminal=True, width=100, color_system=None)

    monkeypatch.setattr(terminal, "Console", console)
    return shown


def test_a_line_a_name_even_if_a_line_ends_in_it(capsys):
    say(f"written to {AWKWARD}", "done")
    assert capsys.readouterr().out == f"written to {SPELLED}\ndone\n"


def test_bars_show_names_letter_by_letter(screen):
    with progress(AWKWARD) as report:
        report(0.5)
    assert list(tracked([1, 2], AWKWARD)) == [1, 2]
    assert SPELLED in screen.getvalue()
    assert "\x1b[31m" not in screen.getvalue() and "\u202e" not in screen.getvalue()


def test_there_are_no_bars_where_there_is_no_terminal(capsys):
    with progress("filtering") as report:
        report(1.0)
    assert capsys.readouterr() == ("", "")
