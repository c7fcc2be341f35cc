"""What commands show on a terminal and in a pipe: tables, bars, and what they are busy with."""

import io
import itertools
import os
import pty
import re
import sys
import threading
from collections.abc import Callable, Mapping

import pytest

from fitting.cli import main
from fitting.cli.terminal import plain_lines, printing, show, watched
from fitting.cli.terminal.plain_lines import PlainLines
from fitting.jobs import examples
from fitting.report.formatting import aligned, joined
from fitting.report.guides.layout import wrapped
from fitting.runtime import activity

ESCAPE, RULE = "\x1b", "─"
COLOUR = re.compile(r"\x1b\[[\d;]*3\d[\d;]*m")  # of the text
CODES = re.compile(r"\x1b\[[?\d;]*[A-Za-z]")
TABLE = aligned([["situation", "record"], ["stairs up", "8.2!"], ["flat walk", "3.0"]])


class Screen:
    """A terminal, and what it got."""

    def __init__(self) -> None:
        self._reader, writer = pty.openpty()
        self.stream = os.fdopen(writer, "w", encoding="utf-8")
        self._parts: list[bytes] = []
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        while True:
            try:
                part = os.read(self._reader, 65536)
            except OSError:  # so ends a terminal of Linux
                return
            if not part:  # and so one of macOS
                return
            self._parts.append(part)

    def close(self) -> str:
        """What the terminal got."""
        self.stream.close()
        self._thread.join()
        os.close(self._reader)
        return b"".join(self._parts).decode().replace("\r\n", "\n")


def on_terminal(
    monkeypatch,
    act: Callable[[], object],
    columns: int = 80,
    environment: Mapping[str, str] = {},
) -> str:
    """What an act prints on a terminal of these columns."""
    screen = Screen()
    for name in ("NO_COLOR", "FORCE_COLOR", "LINES"):
        monkeypatch.delenv(name, raising=False)
    wanted = {"TERM": "xterm-256color", "COLUMNS": str(columns)} | dict(environment)
    for name, value in wanted.items():
        monkeypatch.setenv(name, value)
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", screen.stream)
        patch.setattr(sys, "stderr", screen.stream)
        act()
    return screen.close()


def lines_of(text: str) -> list[str]:
    return [line.rstrip() for line in CODES.sub("", text).splitlines()]


# Results


def test_a_terminal_gets_a_drawn_table_and_a_pipe_the_same_as_plain_text(monkeypatch, capsys):
    drawn = on_terminal(monkeypatch, lambda: main.main(["example"]))
    assert main.main(["example"]) == 0
    plain = capsys.readouterr()
    rows = [["name", "experiment"], *([name, title] for name, title in examples.names().items())]
    assert plain.out == f"{aligned(rows)}\n" and plain.err == ""
    assert ESCAPE in drawn and RULE in drawn
    assert all(name in drawn and title[:20] in drawn for name, title in rows)


@pytest.mark.parametrize("columns", [50, 80, 200])
@pytest.mark.parametrize("command", [["parameters", "stride"], ["schema"]])
def test_lists_fit_into_the_width_of_the_terminal(command, columns, monkeypatch, capsys):
    drawn = on_terminal(monkeypatch, lambda: main.main(command), columns)
    assert main.main(command) == 0
    plain = capsys.readouterr().out.splitlines()  # whose cells without prose take 75
    for lines, widest in ((lines_of(drawn), columns), (plain, max(columns, 75))):
        assert len(lines) > 80 and max(map(len, lines)) <= widest


def test_marks_are_red_and_without_colours_where_there_shall_be_none(monkeypatch):
    coloured, colourless, dumb = (
        on_terminal(monkeypatch, lambda: show(TABLE), environment=environment)
        for environment in ({}, {"NO_COLOR": "1"}, {"TERM": "dumb"})
    )
    assert f"{ESCAPE}[31m8.2!" in coloured and f"{ESCAPE}[31m3.0" not in coloured
    assert RULE in colourless and not COLOUR.search(colourless)
    assert dumb == f"{TABLE}\n"


def test_tables_in_longer_text_are_drawn_and_paths_stay_whole(monkeypatch, capsys):
    path = "/a/long/path" * 10
    text = joined(["", "a sentence", joined([TABLE, "bounds"], apart=True), f"written to {path}"])
    assert text == f"\na sentence\n{TABLE}\n\nbounds\nwritten to {path}"
    drawn = on_terminal(monkeypatch, lambda: show(text), 60)
    lines = lines_of(drawn)
    assert lines[:2] == ["", "a sentence"] and RULE in lines[3] and "-" * 10 not in drawn
    assert path in drawn.splitlines()[-1]
    show(text)
    assert capsys.readouterr().out == f"{text}\n"


def test_a_table_that_is_too_wide_becomes_two_which_begin_alike(monkeypatch):
    rows = [["parameter", *(f"column {number}" for number in range(6))]]
    rows += [["leg.twist", *(f"{number} to {number + 10}.0" for number in range(6))]]
    lines = lines_of(on_terminal(monkeypatch, lambda: show(aligned(rows)), 50))
    cells = [re.split(r"  +", line) for line in lines if line and RULE not in line]
    assert max(map(len, lines)) <= 50 and len(cells) == 4
    assert [*cells[0], *cells[2][1:]] == rows[0] and cells[2][0] == "parameter"
    assert [*cells[1], *cells[3][1:]] == rows[1] and cells[3][0] == "leg.twist"


def test_prose_stands_beside_its_columns_or_below_them(monkeypatch):
    prose = "Largest interior angle of the knee; pi is a straight leg."
    table = wrapped([["leg: TwoBone"], ["leg.max_knee_angle", prose]], 60)
    for columns, first in ((60, "leg.max_knee_angle  Largest"), (40, "leg.max_knee_angle")):
        lines = lines_of(on_terminal(monkeypatch, lambda: show(table), columns))
        assert lines[0] == "leg: TwoBone" and lines[1].startswith(first)
        assert " ".join(" ".join(lines[1:]).split()) == f"leg.max_knee_angle {prose}"


@pytest.mark.parametrize("words", [["--help"], ["fit", "--help"]])
def test_help_has_colours_on_a_terminal_only(words, monkeypatch, capsys):
    def ask() -> None:
        with pytest.raises(SystemExit, match="0"):
            main.main(words)

    drawn = on_terminal(monkeypatch, ask)
    ask()
    plain = capsys.readouterr().out
    assert ESCAPE in drawn and ESCAPE not in plain
    undrawn = CODES.sub("", drawn).rpartition("example")[2]
    assert undrawn.split() == plain.rpartition("example")[2].split()


# What a command is busy with


def work_for_a_while() -> None:
    with watched(), activity.announced("Searching from 4 starts", 4) as searching:
        searching.reach(1)
        searching.advance()
        activity.note("cost 12.5")
        with activity.announced("Descending"):
            show("a result meanwhile")
        searching.advance()


def test_a_terminal_gets_bars_and_results_above_them(monkeypatch):
    monkeypatch.setattr(plain_lines, "PATIENCE", 1.5)
    seconds = itertools.count()
    monkeypatch.setattr(activity.time, "monotonic", lambda: float(next(seconds)))
    drawn = on_terminal(monkeypatch, work_for_a_while, 100)
    text = CODES.sub("", drawn)
    for part in ("━", "Searching from 4 starts", "2 of 4, ", " s each, ", " s left", "cost 12.5"):
        assert part in text
    assert "  Descending" in text
    assert "\na result meanwhile\n" in text.replace("\r", "\n")
    assert drawn.rfind(f"{ESCAPE}[?25h") > drawn.rfind(f"{ESCAPE}[?25l")  # the cursor is back
    assert "Searching from 4 starts: " in lines_of(drawn)[-1]


def test_a_dumb_terminal_and_a_pipe_get_plain_lines_without_codes(monkeypatch, capsys):
    dumb = on_terminal(monkeypatch, work_for_a_while, environment={"TERM": "dumb"})
    assert dumb == "a result meanwhile\n"
    work_for_a_while()
    assert capsys.readouterr() == ("a result meanwhile\n", "")


def test_a_terminal_of_other_letters_and_a_closed_one_get_plain_lines(monkeypatch):
    monkeypatch.setenv("TERM", "xterm-256color")
    for encoding, wanted in (("utf-8", True), ("latin-1", False)):
        stream = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
        monkeypatch.setattr(stream, "isatty", lambda: True, raising=False)
        assert printing.can_draw(stream) is wanted
    assert not printing.can_draw(None)


class Clock:
    """A clock that is set by hand, and the lines that it makes a pipe get."""

    def __init__(self, monkeypatch):
        self.now = 0.0
        for name, seconds in {"PATIENCE": 1.5, "INTERVAL": 10.0, "SILENCE": 60.0}.items():
            monkeypatch.setattr(plain_lines, name, seconds)
        monkeypatch.setattr(plain_lines.time, "monotonic", lambda: self.now)
        self._stream = io.StringIO()
        self.lines = PlainLines(self._stream)

    def wait(self, seconds: float) -> list[str]:
        """Lets time pass; the lines that came since it was last asked."""
        for _ in range(round(seconds * 10)):
            self.now += 0.1
            self.lines.look()
        text = self._stream.getvalue()
        self._stream.seek(0)
        self._stream.truncate()
        return text.splitlines()


def test_work_is_announced_within_two_seconds_and_what_is_short_not_at_all(monkeypatch):
    clock = Clock(monkeypatch)
    with activity.watched_by(clock.lines):
        with activity.announced("Short"):
            assert clock.wait(1.0) == []
        with activity.announced("Long"):
            assert clock.wait(2.0) == ["Long ..."]
            assert clock.wait(50.0) == []
            assert clock.wait(20.0) == ["  61.5 s  Long"]
        assert clock.wait(0.0) == ["Long: 72.0 s"]
        with pytest.raises(KeyError), activity.announced("Failing"):
            clock.wait(2.0)
            raise KeyError
        assert clock.wait(5.0) == ["Failing: stopped after 2.0 s"]


def test_progress_is_reported_every_ten_seconds_with_the_time_left(monkeypatch):
    clock = Clock(monkeypatch)
    with activity.watched_by(clock.lines), activity.announced("Fitting", 10) as fitting:
        lines = clock.wait(2.0)
        for second in range(30):
            activity.note(f"cost {second}")
            lines += clock.wait(1.0)
            if second % 3 == 2:
                fitting.advance()
        lines += clock.wait(0.1)
    assert lines == [
        "Fitting ...",
        "  12.0 s  Fitting, 3 of 10, 24 s left: cost 10",
        "  22.0 s  Fitting, 6 of 10, 14 s left: cost 20",
    ]


def test_what_is_compiled_is_named_with_its_seconds(monkeypatch):
    clock = Clock(monkeypatch)
    with activity.watched_by(clock.lines), activity.announced("Preparing") as preparing:
        preparing.began_compiling("step")
        assert clock.wait(2.0) == ["Preparing: compiling step (2 s) ..."]
        preparing.began_compiling("evaluate")
        wanted = ["  11.6 s  Preparing: compiling step (12 s), evaluate (10 s)"]
        assert clock.wait(11.0) == wanted
        preparing.ended_compiling("step")
        preparing.ended_compiling("evaluate")
        assert clock.wait(40.0) == []
    assert clock.wait(0.0) == ["Preparing: 53.0 s"]


def test_what_is_repeated_within_other_work_is_announced_once(monkeypatch):
    clock = Clock(monkeypatch)
    with activity.watched_by(clock.lines), activity.announced("Fitting 100 replicates", 100):
        lines = clock.wait(2.0)
        for _ in range(100):
            with activity.announced("Searching"):
                lines += clock.wait(3.0)
    announcements = [line for line in lines if line.endswith(" ...")]
    assert announcements == ["Fitting 100 replicates ...", "Searching ..."]
    assert len(lines) <= 3 + 300 / 60
