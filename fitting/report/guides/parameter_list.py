"""Every parameter of a system, with default, unit, range and meaning."""

import dataclasses
import json
import math
import operator

import numpy as np

import jaxik
from fitting.experiments import systems
from fitting.report.formatting import Table, interval, markdown
from jaxik.maths import parameter_tree

from .layout import wrapped

HEADING = ["parameter", "default", "range", "meaning"]


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One field of a rule as lists show it."""

    name: str
    """Dotted."""
    rule: str
    """Of its stage."""
    default: object
    """A number, a switch, or a list of them; infinity is "inf", as in JSON there is none."""
    default_text: str
    """With its unit."""
    unit: str
    """"1" for a plain number and for a switch."""
    low: float | None
    """A fit goes no lower; None for what no fit changes."""
    high: float | None
    kind: str | None
    """"smooth" or "threshold"; None likewise."""
    scale: str | None
    meaning: str

    @property
    def range(self) -> str:
        """The range as text."""
        return "" if self.low is None or self.high is None else interval(self.low, self.high)

    def mentions(self, word: str) -> bool:
        """Whether a word is in the name, the rule or the meaning."""
        return word.lower() in f"{self.name} {self.rule} {self.meaning}".lower()


def list_parameters(ik: jaxik.FootIK, word: str = "") -> list[Parameter]:
    """The parameters, conventions, switches and options of a system, stage by stage.

    Args:
        ik: the system.
        word: only those that mention it.
    """
    rules = systems.rule_names(ik)
    units = {slot.name: slot.unit for slot in parameter_tree.slots(ik)}
    declared = parameter_tree.declarations(ik)
    parameters = []
    for name, doc in parameter_tree.docs(ik).items():
        declaration = declared.get(name)
        parameters.append(
            Parameter(
                name=name,
                rule=rules[name.partition(".")[0]],
                default=_plain(np.asarray(operator.attrgetter(name)(ik)).tolist()),
                default_text=parameter_tree.shown(ik, name),
                unit=units.get(name, "1"),
                low=None if declaration is None else declaration.low,
                high=None if declaration is None else declaration.high,
                kind=None if declaration is None else declaration.kind,
                scale=None if declaration is None else declaration.scale,
                meaning=doc,
            )
        )
    return [parameter for parameter in parameters if parameter.mentions(word)]


def as_text(parameters: list[Parameter], width: int) -> str:
    """The list for a terminal with this many columns."""
    table: Table = [HEADING]
    stage = ""
    for parameter in parameters:
        if (own := parameter.name.partition(".")[0]) != stage:
            stage = own
            table.append([f"{stage}: {parameter.rule}"])
        table.append(_cells(parameter))
    return wrapped(table, width)


def as_markdown(parameters: list[Parameter]) -> str:
    """The list as a table in Markdown."""
    return markdown([HEADING, *map(_cells, parameters)])


def as_json(parameters: list[Parameter]) -> str:
    """The list as JSON."""
    rows = [dataclasses.asdict(parameter) for parameter in parameters]
    for row in rows:
        del row["default_text"]
    return json.dumps(rows, indent=1, ensure_ascii=False, allow_nan=False)


def _cells(parameter: Parameter) -> list[str]:
    return [parameter.name, parameter.default_text, parameter.range, parameter.meaning]


def _plain(value: object) -> object:
    """A value as JSON holds it, without the digits that 32 bits do not have."""
    if isinstance(value, list):
        return [_plain(entry) for entry in value]
    if isinstance(value, float):
        return float(f"{value:.7g}") if math.isfinite(value) else str(value)
    return value
