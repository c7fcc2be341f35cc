"""Lists of a system's parameters, and of the keys of experiment files, with their meaning."""

import dataclasses
import json
import math
import operator
from collections.abc import Iterator

import numpy as np

import jaxik
from fitting.experiment import systems
from fitting.runtime.validation import Content
from jaxik.maths import parameter_tree

from .formatting import Table, interval

KEY_HEADING = ["key", "value", "default", "meaning"]
WORDS = {"boolean": "true, false", "string": "text", "object": "table", "null": ""}
WIDEST = 24  # characters of what a value may be; more choices stand in the meaning
BY_PARAMETER = ("parameters", "free", "start")  # tables whose keys are those of the parameters


PARAMETER_HEADING = ["parameter", "default", "range", "meaning"]


def key_table(schema: Content) -> Table:
    """The keys of a schema, a row each."""
    return [KEY_HEADING, *_rows(schema)]


def _rows(schema: Content, path: str = "") -> Iterator[list[str]]:
    """A row for each key of a table, and for those of the tables in it."""
    for key, entry in schema["properties"].items():
        if "description" not in entry:  # the parameters of a stage
            continue
        default = entry.get("default", "")
        text = f"{default:.4g}" if isinstance(default, float) else str(default)
        text = text.lower() if isinstance(default, bool) else text
        value, meaning = _value(entry), entry["description"]
        if len(value) > WIDEST:
            value, meaning = "choice", f"{meaning} One of {value}."
        yield [f"{path}{key}", value, text, meaning]
        inner = entry.get("items", entry)
        if key not in BY_PARAMETER and "properties" in inner:
            yield from _rows(inner, f"{path}{key}.")


def _value(entry: Content) -> str:
    """What a value may be, in words."""
    if "$ref" in entry:
        return "table"
    if "enum" in entry:
        return ", ".join(entry["enum"])
    if "anyOf" in entry:
        return " or ".join(word for word in map(_value, entry["anyOf"]) if word)
    match entry["type"]:
        case "number" | "integer" if "maximum" in entry:
            whole = "whole, " if entry["type"] == "integer" else ""
            return f"{whole}{entry['minimum']:g} to {entry['maximum']:g}"
        case "number":
            return "inf"
        case "array":
            return "tables" if "properties" in entry["items"] else "list"
        case type_name:
            return WORDS[type_name]


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
    """"smooth" or "threshold"; None for what no fit changes."""
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


def parameter_table(parameters: list[Parameter], *, headings: bool = False) -> Table:
    """A row for each parameter, and if wanted a row of one cell before those of each stage."""
    table: Table = [PARAMETER_HEADING]
    stage = ""
    for parameter in parameters:
        if headings and (own := parameter.name.partition(".")[0]) != stage:
            stage = own
            table.append([f"{stage}: {parameter.rule}"])
        table.append([parameter.name, parameter.default_text, parameter.range, parameter.meaning])
    return table


def as_json(parameters: list[Parameter]) -> str:
    """The list as JSON."""
    rows = [dataclasses.asdict(parameter) for parameter in parameters]
    for row in rows:
        del row["default_text"]
    return json.dumps(rows, indent=1, ensure_ascii=False, allow_nan=False)


def _plain(value: object) -> object:
    """A value as JSON holds it, without the digits that 32 bits do not have."""
    if isinstance(value, list):
        return [_plain(entry) for entry in value]
    if isinstance(value, float):
        return float(f"{value:.7g}") if math.isfinite(value) else str(value)
    return value
