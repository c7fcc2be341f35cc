"""Finds jaxik, which lives in a Python of its own, and runs it beside Blender."""

import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

from .exchange import Refusal

INSTALL = (
    'python -m venv jaxik && jaxik\\Scripts\\pip install "jaxik[fit]"'
    if os.name == "nt"
    else 'python3 -m venv jaxik && jaxik/bin/pip install "jaxik[fit]"'
)
ABSENT = (
    "jaxik is not there: the add-on's preferences have the command that installs it, and a field "
    "for its Python"
)
START = "import sys; from fitting.cli.start import main; sys.exit(main())"
EXPORTER = Path(__file__).with_name("python.txt")
"""Names the Python of the jaxik that wrote this add-on."""
WARNING, NOTE = "jaxik: ", "note: "  # begin lines of stderr and stdout
IN_PYTHON = re.compile(r" \(\w+=\.\.\. in Python\)")
FIELDS = {
    "--root ground": "Root On the ground",
    "--scale": "Metres per unit",
    "--floor": "Floor",
    "--sole": "Sole",
    "--travel": "Travel",
}
"""What the panel calls the options that jaxik advises."""
UNKNOWN_LEGS = "no pair of legs recognised"
ADVICE = "; write a map with"


def command(python: str) -> list[str]:
    """The words that start jaxik.

    Args:
        python: of the environment that has it, "" for the one that wrote the add-on or else the
            command on PATH.

    Raises:
        Refusal: there is none.
    """
    exporter = EXPORTER.read_text(encoding="utf-8").strip() if EXPORTER.exists() else ""
    if not python and not Path(exporter).is_file():
        on_path = shutil.which("jaxik")
        if on_path is None:
            raise Refusal(ABSENT)
        return [on_path]
    return [python or exporter, "-c", START]


def run(start: list[str], words: list[str], folder: Path) -> Iterator[str]:
    """Runs jaxik, and yields what it is doing; ends it when it is closed.

    Args:
        start: the words that start it.
        words: its arguments.
        folder: in which it runs, and leaves `stdout` and `stderr`.

    Raises:
        Refusal: it is not there, or has failed.
    """
    quiet = getattr(subprocess, "CREATE_NO_WINDOW", 0)
    streams = [folder / name for name in ("stdout", "stderr")]
    with streams[0].open("wb") as out, streams[1].open("wb") as err:
        try:
            process = subprocess.Popen(
                [*start, *words], cwd=folder, stdin=subprocess.DEVNULL, stdout=out, stderr=err,
                env={**os.environ, "PYTHONUTF8": "1"}, creationflags=quiet,
            )  # fmt: skip
        except OSError as error:
            raise Refusal(f"{start[0]} cannot be run: {error.strerror}; {ABSENT}") from None
    try:
        while process.poll() is None:
            yield (_lines(streams[1]) or ["starting jaxik"])[-1]
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
    if process.returncode:
        raise Refusal(_reason(_lines(streams[1]), process.returncode))


def remarks(folder: Path) -> list[str]:
    """What jaxik, run in this folder, has warned of and noted."""
    beginnings = {"stderr": WARNING, "stdout": NOTE}
    lines = [
        line.removeprefix(beginning)
        for stream, beginning in beginnings.items()
        for line in _lines(folder / stream)
        if line.startswith(beginning)
    ]
    return [_in_fields(line) for line in lines]


def _in_fields(line: str) -> str:
    """Advice as the panel has it."""
    line = IN_PYTHON.sub("", line)
    for option, field in FIELDS.items():
        line = line.replace(option, field)
    return line


def _reason(lines: list[str], status: int) -> str:
    """Why jaxik has failed, in one line."""
    last = lines[-1] if lines else f"jaxik has ended with status {status}"
    if "No module named" in last:
        return ABSENT
    if UNKNOWN_LEGS in last:
        return "the names of the bones do not say which are legs; choose them under Bones"
    return last.replace(ADVICE, "; choose the bones in the panel, or write a map with")


def _lines(path: Path) -> list[str]:
    """What stands in a stream so far."""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    return [line.strip() for line in lines if line.strip()]
