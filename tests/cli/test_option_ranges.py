"""The range of every number among the options: its ends are accepted, nothing beyond is."""

import pytest

from fitting.cli.parser import make_parser
from support.commands import commands

OF_CLIPS = {"--scale": ("1e-9", "1e6")}
OF_TERRAINS = {"--terrain-scale": ("1e-9", "1e6"), "--terrain-cell": ("0.001", "1e4")}
OF_TERRAINS |= {"--terrain-offset": ("-1e6", "1e6")}
OF_ANIMATIONS = {"--floor": ("-1e6", "1e6"), "--speed": ("0.01", "100")} | OF_CLIPS | OF_TERRAINS
OF_PAGES = {"--port": ("0", "65535")}
OF_RECORDS = {"--tick-hz": ("1", "1000")}
RANGES = {  # by command, with other words that it needs
    "init walk.bvh -o out": OF_CLIPS | OF_TERRAINS,
    "ablate e.toml -o out": {"--folds": ("2", "1000")},
    "calibrate e.toml -o out": {
        "--replicates": ("1", "100000"), "--workers": ("0", "1024"),
        "--noise-factor": ("0.001", "1000"),
    },
    "fit-many e.toml -o out": {"--seeds": ("1", "10000"), "--workers": ("0", "1024")},
    "sample run": {"--max-steps": ("1", "1000000000")},
    "apply run walk.bvh --terrain hill.ply -o out": OF_ANIMATIONS,
    "fit e.toml -o out": OF_PAGES,
    "run walk.bvh --terrain hill.ply -o out": OF_ANIMATIONS,
    "view walk.bvh --terrain hill.ply -o out": OF_ANIMATIONS | OF_PAGES,
    "compare walk.bvh --terrain hill.ply -o out": OF_ANIMATIONS | {"--rates": ("1", "1000")},
    "translate --from mec --to record --clip a --terrain b -o out":
        {"--fps": ("1", "1000")} | OF_CLIPS | OF_TERRAINS,
    "inspect walk.bvh": OF_CLIPS,
    "terrain walk.bvh -o hill.ply": {"--sole": ("0", "10"), "--margin": ("0", "100")} | OF_CLIPS,
    "record show footik.bin": OF_RECORDS,
    "record to-toml footik.bin -o out": OF_RECORDS,
    "record to-bytes footik.toml -o out": OF_RECORDS,
}  # fmt: skip
ODD = ("", "x", "nan", "inf", "-inf", "1e300", "-1e300", "1" * 5000, "10" * 20, "0x10", "1;2", "\0")


def command_of(line: str) -> str:
    """The words of a line that name its command."""
    return max((name for name in commands() if f"{line} ".startswith(f"{name} ")), key=len)


def beyond(end: str, *, up: bool) -> str:
    """A number just outside a range."""
    if "." in end or "e" in end:
        return repr(float(end) * (1.001 if up == (float(end) > 0) else 0.999))
    return str(int(end) + (1 if up else -1))


def words(option: str, value: str) -> list[str]:
    """An option with its value, as a user types it."""
    return [option, "0", value, "0"] if option == "--terrain-offset" else [f"{option}={value}"]


@pytest.mark.parametrize("line", RANGES)
def test_a_number_is_accepted_up_to_the_ends_of_its_range(line, capsys):
    command, parser = command_of(line), make_parser()
    for option, (low, high) in RANGES[line].items():
        for value in (low, high):
            parser.parse_args([*line.split(), *words(option, value)])
        for value in (beyond(low, up=False), beyond(high, up=True), *ODD):
            with pytest.raises(SystemExit, match="2"):
                parser.parse_args([*line.split(), *words(option, value)])
            error = capsys.readouterr().err
            assert error.count("\n") == 1 and len(error) < 1100 and error[:-1].isprintable()
            assert error.startswith(f"jaxik {command}: argument ") and option in error
            assert "; wanted a" in error and "--help" in error


def test_every_number_among_the_options_has_a_range_here():
    numbers = {}
    for command, parser in commands().items():
        for action in parser._actions:
            if not action.option_strings or action.choices is not None or action.type is None:
                continue
            if getattr(action.type, "__module__", "").endswith("parsers.options"):
                numbers.setdefault(command, set()).add(action.option_strings[-1])
            else:  # a path, or a converter of other texts
                assert action.type not in (int, float), action
    assert numbers == {command_of(line): set(options) for line, options in RANGES.items()}
