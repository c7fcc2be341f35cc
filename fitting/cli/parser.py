"""The words and options of the command `jaxik`. Imports no JAX, so that `--help` is fast."""

import argparse
import re
from typing import TYPE_CHECKING, Any, NoReturn

from fitting.runtime.validation import in_one_line

from . import animations, files, fits, guides, machine
from .terminal import show_help

if TYPE_CHECKING:
    from _typeshed import SupportsWrite

EXAMPLES = """examples:
  jaxik init walk.bvh -o walk                                  a first experiment of your clip
  jaxik fit data/experiments/uneven_walk.toml -o runs/walk     fit, with plots and a summary
  jaxik ablate data/experiments/blocks.toml -o runs/ablation   the fit without each of its rules
  jaxik calibrate data/experiments/ozz.toml -o runs/known      fits of known truths, judged
  jaxik population walks.toml -o runs/walks                    several subjects, and their spread
  jaxik fit-many walks.toml --seeds 3 -o runs/all              each clip alone, on all cores
  jaxik sample runs/walk                                       its posterior; again to continue
  jaxik apply runs/walk walk.bvh --terrain steps.obj -o walk_on_steps.npz
  jaxik run walk.bvh --terrain steps.obj -o walk_on_steps.npz --preset record
  jaxik view runs/walk                                         its parameters, live in the browser
  jaxik compare walk.bvh --terrain steps.obj --presets ozz,unreal,mec,record -o compared
  jaxik compare --suite -o suite                               systems in made situations
  jaxik translate --from mec --to record --clip walk.bvh --terrain steps.obj -o translated
  jaxik inspect walk.bvh
  jaxik terrain walk.bvh -o ground.ply
  jaxik record to-toml footik.bin -o footik.toml
  jaxik export runs/walk --as unreal -o walk.csv               in a game engine's names and units
  jaxik export runs/walk --as c -o code                        the system itself, for an engine
  jaxik bench --quick
  jaxik cache                                                  where compiled programs are cached
  jaxik parameters stride                                      what each one is and does
  jaxik schema                                                 all keys of an experiment file
  jaxik example uneven_walk -o walk                            an experiment to begin with
  jaxik doctor                                                 is this installation all right?
  jaxik completion bash                                        for the shell's Tab key

exit status: 0 when done, 1 when `doctor` finds a problem, 2 for a mistake in the input, 3 when the
search of `fit`, `fit-many`, `population` or `translate` has not converged, 4 when `fit` has
converged but does not fit, 5 when `calibrate` finds something outside its bounds, 6 when a fit of
`fit-many` has failed, 7 when a fit is worse than the animation or the system before it, 130 when
interrupted with Ctrl-C, which is how `view` ends, with 0: `fit` then has written the best point so
far, `sample` its chain, `ablate`, `calibrate`, `fit-many` and `population` each finished fit, and
`compare --suite` each finished situation.
`jaxik COMMAND --help` has more examples.
"""

COMMANDS = (
    fits.init, fits.fit, fits.ablate, fits.calibrate, fits.population, fits.fit_many, fits.sample,
    animations.apply, animations.run, animations.view, animations.compare, fits.translate,
    files.inspect, files.terrain, machine.bench, files.record, files.export, machine.cache,
    guides.parameters, guides.schema, guides.example, machine.doctor, machine.completion,
)  # fmt: skip


class Parser(argparse.ArgumentParser):
    """A parser that reports a mistake as the commands do: in one line, with status 2."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.color = False  # which Python 3.14 would add to ours
        self._negative_number_matcher = re.compile(r"-(\.?\d|inf)")  # or -1e3 is an option

    def print_help(self, file: "SupportsWrite[str] | None" = None) -> None:
        """Prints the help, in colour on a terminal."""
        if file is None:
            show_help(self.format_help())
        else:
            super().print_help(file)

    def error(self, message: str) -> NoReturn:
        """Prints what is wrong with the words, without the usage, and exits."""
        line = in_one_line(ValueError(message))
        self.exit(2, f"{self.prog}: {line}; see `{self.prog} --help`\n")


def make_parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    top = Parser(
        prog="jaxik",
        description="Fits the parameters of foot IK to captured motion, with their uncertainty.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in COMMANDS:
        command.add_to(commands)
    return top
