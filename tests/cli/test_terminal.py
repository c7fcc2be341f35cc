"""What commands show on a terminal and in a pipe: tables, bars, and what they are busy with."""

import contextlib
import io
import itertools
import os
import pty
import re
import sys
import threading

import pytest

from fitting.cli import main, terminal
from fitting.cli.terminal import PlainLines, show, watched
from fitting.report.formatting import aligned, joined, wrapped
from fitting.runtime import activity
from fitting.studies import exports
from support.watching import Recorder

ESCAPE, RULE = "\x1b", "─"
COLOUR = re.compile(r"\x1b\[[\d;]*3\d[\d;]*m")  # of the text
CODES = re.compile(r"\x1b\[[?\d;]*[A-Za-z]")
TABLE = aligned([["situation", "record"], ["stairs up", "8.2!"], ["flat walk", "3.0"]])


def on_terminal(monkeypatch, act, columns: int = 80, **environment: str) -> str:
    """What an act prints on a terminal of these columns."""
    reader, writer = pty.openpty()
    parts: list[bytes] = []

    def read() -> None:
        with contextlib.suppress(OSError):  # so ends a terminal of Linux
            while part := os.read(reader, 65536):  # and with nothing one of macOS
                parts.append(part)

    for name in ("NO_COLOR", "FORCE_COLOR", "LINES"):
        monkeypatch.delenv(name, raising=False)
    for name, value in ({"TERM": "xterm-256color", "COLUMNS": str(columns)} | environment).items():
        monkeypatch.setenv(name, value)
    thread = threading.Thread(target=read)
    thread.start()
    with monkeypatch.context() as patch, os.fdopen(writer, "w", encoding="utf-8") as stream:
        patch.setattr(sys, "stdout", stream)
        patch.setattr(sys, "stderr", stream)
        act()
    thread.join()
    os.close(reader)
    return b"".join(parts).decode().replace("\r\n", "\n")


def lines_of(text: str) -> list[str]:
    return [line.rstrip() for line in CODES.sub("", text).splitlines()]


def test_a_terminal_gets_drawn_tables_that_fit_its_width_and_a_pipe_plain_text(monkeypatch, capsys):
    drawn = on_terminal(monkeypatch, lambda: main.main(["example"]))
    assert main.main(["example"]) == 0
    plain = capsys.readouterr()
    rows = [["name", "experiment"], *([name, title] for name, title in exports.names().items())]
    assert plain.out == f"{aligned(rows)}\n" and plain.err == ""
    assert ESCAPE in drawn and RULE in drawn
    assert all(name in drawn and title[:20] in drawn for name, title in rows)
    for columns in (50, 200):
        for command in (["parameters", "stride"], ["schema"]):
            drawn = on_terminal(monkeypatch, lambda words=command: main.main(words), columns)
            assert main.main(command) == 0
            pipe = capsys.readouterr().out.splitlines()  # whose cells without prose take 75
            for lines, widest in ((lines_of(drawn), columns), (pipe, max(columns, 75))):
                assert len(lines) > 80 and max(map(len, lines)) <= widest, (command, columns)


def test_marks_are_red_where_there_may_be_colours_and_paths_stay_whole(monkeypatch, capsys):
    coloured, colourless, dumb = (
        on_terminal(monkeypatch, lambda: show(TABLE), 80, **environment)
        for environment in ({}, {"NO_COLOR": "1"}, {"TERM": "dumb"})
    )
    assert f"{ESCAPE}[31m8.2!" in coloured and f"{ESCAPE}[31m3.0" not in coloured
    assert RULE in colourless and not COLOUR.search(colourless)
    assert dumb == f"{TABLE}\n"
    path = "/a/long/path" * 10
    text = joined(["", "a sentence", joined([TABLE, "bounds"], apart=True), f"written to {path}"])
    assert text == f"\na sentence\n{TABLE}\n\nbounds\nwritten to {path}"
    drawn = on_terminal(monkeypatch, lambda: show(text), 60)
    lines = lines_of(drawn)
    assert lines[:2] == ["", "a sentence"] and RULE in lines[3] and "-" * 10 not in drawn
    assert path in drawn.splitlines()[-1]
    show(text)
    assert capsys.readouterr().out == f"{text}\n"


def test_what_is_too_wide_becomes_two_tables_which_begin_alike_or_prose_below(monkeypatch):
    rows = [["parameter", *(f"column {number}" for number in range(6))]]
    rows += [["leg.twist", *(f"{number} to {number + 10}.0" for number in range(6))]]
    lines = lines_of(on_terminal(monkeypatch, lambda: show(aligned(rows)), 50))
    cells = [re.split(r"  +", line) for line in lines if line and RULE not in line]
    assert max(map(len, lines)) <= 50 and len(cells) == 4
    assert [*cells[0], *cells[2][1:]] == rows[0] and cells[2][0] == "parameter"
    assert [*cells[1], *cells[3][1:]] == rows[1] and cells[3][0] == "leg.twist"
    prose = "Largest interior angle of the knee; pi is a straight leg."
    table = wrapped([["leg: TwoBone"], ["leg.max_knee_angle", prose]], 60)
    for columns, first in ((60, "leg.max_knee_angle  Largest"), (40, "leg.max_knee_angle")):
        lines = lines_of(on_terminal(monkeypatch, lambda: show(table), columns))
        assert lines[0] == "leg: TwoBone" and lines[1].startswith(first)
        assert " ".join(" ".join(lines[1:]).split()) == f"leg.max_knee_angle {prose}"


@pytest.mark.parametrize(
    ("words", "marked"),
    [(["--help"], ["-h", "fit-many"]), (["fit", "--help"], ["-o", "--record-only"])],
)
def test_help_has_colours_on_a_terminal_only(words, marked, monkeypatch, capsys):
    def ask() -> None:
        with pytest.raises(SystemExit, match="0"):
            main.main(words)

    drawn = on_terminal(monkeypatch, ask)
    ask()
    plain = capsys.readouterr().out
    assert all(f"{ESCAPE}[36m{word}" in drawn for word in marked)
    assert f"{ESCAPE}[1musage:" in drawn and ESCAPE not in plain
    examples_of = [text.rpartition("example")[2].split() for text in (CODES.sub("", drawn), plain)]
    assert examples_of[0] == examples_of[1]


# What a command is busy with


def test_work_within_work_is_announced_in_order_and_what_fails_has_ended():
    recorder = Recorder()
    with activity.watched_by(recorder), activity.announced("outer", 2) as outer:
        with outer.part("first"):
            activity.note("in the first")
        with outer.part("second"):
            pass
        activity.note("in the outer")
    assert recorder.events == [
        "began outer", "began first", "noted in the first", "ended first", "outer 1 of 2",
        "began second", "ended second", "outer 2 of 2", "noted in the outer", "ended outer",
    ]  # fmt: skip
    recorder = Recorder()
    with pytest.raises(KeyError), activity.watched_by(recorder), activity.announced("work") as work:
        raise KeyError
    assert recorder.events == ["began work", "ended work"] and work.failed
    with activity.announced("work", 3) as work:
        work.advance()
        activity.note("a note")
    activity.note("after everything")
    assert (work.done, work.note) == (1, "a note")


def test_time_left_follows_from_the_parts_after_the_first_one(monkeypatch):
    now = 100.0
    monkeypatch.setattr(activity.time, "monotonic", lambda: now)
    with activity.announced("work", 50, done=30) as work:
        now = 160.0
        work.reach(31)
        assert work.seconds_left is None
        now = 178.0
        work.reach(40)
        assert work.seconds_each == 2.0 and work.seconds_left == 20.0
        work.reach(50)
        assert work.seconds_left is None


def work_for_a_while() -> None:
    with watched(), activity.announced("Searching from 4 starts", 4) as searching:
        searching.reach(1)
        searching.advance()
        activity.note("cost 12.5")
        with activity.announced("Descending"):
            show("a result meanwhile")
        searching.advance()


def test_a_terminal_gets_bars_and_results_above_them(monkeypatch):
    monkeypatch.setattr(terminal, "PATIENCE", 1.5)
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


def test_a_pipe_and_dumb_strange_and_closed_terminals_get_plain_lines(monkeypatch, capsys):
    dumb = on_terminal(monkeypatch, work_for_a_while, TERM="dumb")
    assert dumb == "a result meanwhile\n"
    work_for_a_while()
    assert capsys.readouterr() == ("a result meanwhile\n", "")
    monkeypatch.setenv("TERM", "xterm-256color")
    for encoding, wanted in (("utf-8", True), ("latin-1", False)):
        stream = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
        monkeypatch.setattr(stream, "isatty", lambda: True, raising=False)
        assert terminal.can_draw(stream) is wanted
    assert not terminal.can_draw(None)


class Clock:
    """A clock that is set by hand, and the lines that it makes a pipe get."""

    def __init__(self, monkeypatch):
        self.now = 0.0
        for name, seconds in {"PATIENCE": 1.5, "INTERVAL": 10.0, "SILENCE": 60.0}.items():
            monkeypatch.setattr(terminal, name, seconds)
        monkeypatch.setattr(terminal.time, "monotonic", lambda: self.now)
        self._stream = io.StringIO()
        self.lines = PlainLines(self._stream)

    def wait(self, seconds: float) -> list[str]:
        """Lets time pass; the lines that came since it was last asked."""
        for _ in range(round(seconds * 10)):
            self.now += 0.1
            self.lines.update()
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


def test_progress_is_reported_every_ten_seconds_and_what_is_repeated_is_announced_once(monkeypatch):
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
    clock = Clock(monkeypatch)
    with activity.watched_by(clock.lines), activity.announced("Fitting 100 replicates", 100):
        lines = clock.wait(2.0)
        for _ in range(100):
            with activity.announced("Searching"):
                lines += clock.wait(3.0)
    announcements = [line for line in lines if line.endswith(" ...")]
    assert announcements == ["Fitting 100 replicates ...", "Searching ..."]
    assert len(lines) <= 3 + 300 / 60
