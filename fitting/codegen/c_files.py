"""The files of a program in C."""

from pathlib import Path

from . import c_code, header
from .functions import fill
from .program import Program

CHECK = "check.c"


def sources(program: Program, name: str, engine: str | None = None) -> dict[str, str]:
    """The header and the functions, by the names of their files; see `export.Language`."""
    schedule = program.schedule()
    constants = "\n\n".join(header.constants(program))
    parts = [c_code.PRELUDE + constants, *c_code.functions(program, schedule)]
    contents = {
        f"{name}.h": header.text(program, schedule, engine),
        f"{name}.c": "\n\n".join(parts) + "\n",
    }
    return {file: filled(text, program, name) for file, text in contents.items()}


def check(program: Program, name: str) -> dict[str, str]:
    """What replays a trace of this program."""
    template = Path(__file__).with_name(CHECK).read_text(encoding="utf-8")
    return {CHECK: filled(template, program, name)}


def filled(template: str, program: Program, name: str) -> str:
    """A text in C with the names of a program, and the calls of a frame, in it."""
    calls = {
        "@CALLS": "\n".join(header.calls(program, "        ")),
        "@POINTED": "\n".join(header.calls(program, "        ", "")),
    }
    return fill(template, calls | {"@NAME": name.upper(), "@file": name, "@": f"{name}_"})
