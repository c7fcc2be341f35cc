"""The files of a program in C."""

from pathlib import Path

from . import c_code, header
from .functions import fill
from .program import Program
from .routines import routines

FOLDER = Path(__file__).parent
CHECK, WALK = "check.c", "walk.c"
NODES = {"unreal": ("unreal.h", "AnimNode_@Name.h"), "godot": ("godot.cpp", "@file_modifier.cpp")}
"""For an engine: what calls the code there, and the name of its file."""


def sources(program: Program, name: str, engine: str | None = None) -> dict[str, str]:
    """The header, the functions and the node of an engine; see `export.Language`."""
    schedule, around = program.schedule(), routines(program)
    constants = "\n\n".join(header.constants(program))
    parts = [c_code.PRELUDE + constants, *c_code.functions(program, schedule, around)]
    contents = {
        "@file.h": header.text(program, schedule, around, engine),
        "@file.c": "\n\n".join(parts) + "\n",
    }
    if engine in NODES:
        template, file = NODES[engine]
        contents[file] = (FOLDER / "engines" / template).read_text(encoding="utf-8")
    return {
        filled(file, program, name): filled(text, program, name) for file, text in contents.items()
    }


def check(program: Program, name: str) -> dict[str, str]:
    """What replays a trace of this program, and what walks its animation over another ground."""
    paths = FOLDER / CHECK, FOLDER / "engines" / WALK
    return {path.name: filled(path.read_text(encoding="utf-8"), program, name) for path in paths}


def filled(template: str, program: Program, name: str) -> str:
    """A text in C with the names of a program, and the calls of a frame, in it."""
    calls = {
        "@CALLS": "\n".join(header.calls(program, "        ")),
        "@CASTING": "\n".join(header.calls(program, "        ", casts=True)),
        "@POINTED": "\n".join(header.calls(program, "        ", "")),
        "@STILL": " hits[i].platform = -1;" if program.platforms else "",
    }
    names = {"@NAME": name.upper(), "@Name": name.title().replace("_", ""), "@file": name}
    return fill(template, calls | names | {"@": f"{name}_"})
