"""Words and options of the commands that explain: what there is, and how this machine is."""

import argparse
from pathlib import Path

from .options import Commands, add_command

SHELLS = ("bash", "zsh", "tcsh", "fish", "powershell")  # that shtab knows


def add_parameters(commands: Commands) -> None:
    """`jaxik parameters`."""
    parameters = add_command(
        commands, "parameters", "list a preset's parameters: default, unit, range, meaning",
        """
        jaxik parameters
        jaxik parameters stride --search knee
        jaxik parameters ozz --format json -o ozz.json
        """,
    )  # fmt: skip
    parameters.add_argument(
        "preset", nargs="?", default="record", metavar="PRESET",
        help="of jaxik.presets (default: record)",
    )  # fmt: skip
    parameters.add_argument(
        "--faithful", action="store_true", help="the original, where the preset differs from it"
    )
    parameters.add_argument(
        "--search", metavar="WORD", help="only those with this word in their name or meaning"
    )
    _add_format(parameters, ("text", "markdown", "json"))


def add_schema(commands: Commands) -> None:
    """`jaxik schema`."""
    schema = add_command(
        commands, "schema", "list all keys of experiment files, or write their JSON Schema",
        """
        jaxik schema                                         as text
        jaxik schema --format json -o experiment.schema.json

        With the first line `#:schema experiment.schema.json` in an experiment file beside it,
        editors with a TOML language server, such as Taplo, complete and check the file.
        """,
    )  # fmt: skip
    _add_format(schema, ("text", "markdown", "json"))


def add_example(commands: Commands) -> None:
    """`jaxik example`."""
    example = add_command(
        commands, "example", "list the experiments that come with jaxik, or copy one",
        """
        jaxik example
        jaxik example uneven_walk -o walk
        jaxik fit walk/uneven_walk.toml -o runs/walk
        """,
    )  # fmt: skip
    example.add_argument("name", nargs="?", metavar="NAME", help="left out, they are listed")
    example.add_argument(
        "-o", "--output", type=Path, metavar="DIR",
        help="folder for the experiment with its clips and terrain (default: NAME)",
    )  # fmt: skip


def add_completion(commands: Commands) -> None:
    """`jaxik completion`."""
    completion = add_command(
        commands, "completion", "print what lets a shell complete words of jaxik",
        """
        jaxik completion bash > ~/.local/share/bash-completion/completions/jaxik
        jaxik completion zsh > ~/.zfunc/_jaxik      a folder of fpath
        jaxik completion fish > ~/.config/fish/completions/jaxik.fish
        jaxik completion powershell > jaxik.ps1     for your profile

        Needs the extra `completion`: pip install "jaxik[completion]".
        """,
    )  # fmt: skip
    completion.add_argument("shell", choices=SHELLS)


def add_doctor(commands: Commands) -> None:
    """`jaxik doctor`."""
    doctor = add_command(
        commands, "doctor", "check this installation, and say what to do about what is wrong",
        """
        jaxik doctor
        jaxik doctor --quick        without the self-test, which takes up to half a minute

        The exit status is 0 if all is well, and 1 if there is a problem.
        """,
    )  # fmt: skip
    doctor.add_argument("--quick", action="store_true", help="leave the self-test out")


def _add_format(command: argparse.ArgumentParser, formats: tuple[str, ...]) -> None:
    command.add_argument("--format", choices=formats, default=formats[0])
    command.add_argument("-o", "--output", type=Path, metavar="FILE", help="instead of printing")
