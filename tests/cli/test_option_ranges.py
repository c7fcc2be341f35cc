"""The range of every number among the options: its ends are accepted, nothing beyond is."""

import argparse

import pytest

from fitting.cli.parser import make_parser

ANIMATION = ["walk.bvh", "--terrain", "hill.ply", "-o", "out"]
TRANSLATE = ["translate", "--from", "mec", "--to", "record", "--clip", "a", "--terrain", "b"]
WORDS = {  # that a command needs
    "init": ["init", "walk.bvh", "-o", "out"],
    "ablate": ["ablate", "e.toml", "-o", "out"],
    "calibrate": ["calibrate", "e.toml", "-o", "out"],
    "fit-many": ["fit-many", "e.toml", "-o", "out"],
    "sample": ["sample", "run"],
    "apply": ["apply", "run", *ANIMATION],
    "fit": ["fit", "e.toml", "-o", "out"],
    "run": ["run", *ANIMATION],
    "view": ["view", *ANIMATION],
    "compare": ["compare", *ANIMATION],
    "translate": [*TRANSLATE, "-o", "out"],
    "inspect": ["inspect", "walk.bvh"],
    "terrain": ["terrain", "walk.bvh", "-o", "hill.ply"],
    "record show": ["record", "show", "footik.bin"],
    "record to-toml": ["record", "to-toml", "footik.bin", "-o", "out"],
    "record to-bytes": ["record", "to-bytes", "footik.toml", "-o", "out"],
}
OF_CLIPS = {"--scale": ("1e-9", "1e6")}
OF_TERRAINS = {"--terrain-scale": ("1e-9", "1e6"), "--terrain-cell": ("0.001", "1e4")}
OF_TERRAINS |= {"--terrain-offset": ("-1e6", "1e6")}
OF_ANIMATIONS = {"--floor": ("-1e6", "1e6"), "--speed": ("0.01", "100")} | OF_CLIPS | OF_TERRAINS
OF_PAGES = {"--port": ("0", "65535")}
RANGES = {
    "init": OF_CLIPS | OF_TERRAINS,
    "ablate": {"--folds": ("2", "1000")},
    "calibrate": {
        "--replicates": ("1", "100000"), "--workers": ("0", "1024"),
        "--noise-factor": ("0.001", "1000"),
    },
    "fit-many": {"--seeds": ("1", "10000"), "--workers": ("0", "1024")},
    "sample": {"--max-steps": ("1", "1000000000")},
    "apply": OF_ANIMATIONS,
    "fit": OF_PAGES,
    "run": OF_ANIMATIONS,
    "view": OF_ANIMATIONS | OF_PAGES,
    "compare": OF_ANIMATIONS | {"--rates": ("1", "1000")},
    "translate": {"--fps": ("1", "1000")} | OF_CLIPS | OF_TERRAINS,
    "inspect": OF_CLIPS,
    "terrain": {"--sole": ("0", "10"), "--margin": ("0", "100")} | OF_CLIPS,
    **{f"record {way}": {"--tick-hz": ("1", "1000")} for way in ("show", "to-toml", "to-bytes")},
}  # fmt: skip
OPTIONS = [(command, option) for command, options in RANGES.items() for option in options]
ODD = ("", "x", "nan", "inf", "-inf", "1e300", "-1e300", "1" * 5000, "10" * 20, "0x10", "1;2", "\0")


def beyond(end: str, *, up: bool) -> str:
    """A number just outside a range."""
    if "." in end or "e" in end:
        return repr(float(end) * (1.001 if up == (float(end) > 0) else 0.999))
    return str(int(end) + (1 if up else -1))


def words(option: str, value: str) -> list[str]:
    """An option with its value, as a user types it."""
    return [option, "0", value, "0"] if option == "--terrain-offset" else [f"{option}={value}"]


@pytest.mark.parametrize(("command", "option"), OPTIONS)
def test_a_number_is_accepted_up_to_the_ends_of_its_range(command, option, capsys):
    low, high = RANGES[command][option]
    for value in (low, high):
        make_parser().parse_args([*WORDS[command], *words(option, value)])
    for value in (beyond(low, up=False), beyond(high, up=True), *ODD):
        with pytest.raises(SystemExit, match="2"):
            make_parser().parse_args([*WORDS[command], *words(option, value)])
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and len(error) < 1100 and error[:-1].isprintable()
        assert error.startswith(f"jaxik {command}: argument ") and option in error
        assert "; wanted a" in error and "--help" in error


def parsers(parser: argparse.ArgumentParser, command: str = "") -> dict[str, list[str]]:
    """The options of each command that take a converted value, paths and texts aside."""
    options: dict[str, list[str]] = {}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, child in action.choices.items():
                options |= parsers(child, f"{command} {name}".strip())
        elif action.option_strings and action.choices is None and callable(action.type):
            if getattr(action.type, "__module__", "").endswith("parsers.options"):
                options.setdefault(command, []).append(action.option_strings[-1])
            else:
                assert getattr(action.type, "__name__", "") not in ("int", "float"), action
    return options


def test_every_number_among_the_options_has_a_range_here():
    listed = {command: sorted(options) for command, options in RANGES.items()}
    assert {name: sorted(options) for name, options in parsers(make_parser()).items()} == listed
