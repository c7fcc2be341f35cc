"""Every key of an experiment file, with what it may be, default and meaning, from its schema."""

from collections.abc import Iterator

from fitting.report.formatting import Table, markdown
from fitting.runtime.validation import Content

from .layout import wrapped

HEADING = ["key", "value", "default", "meaning"]
WORDS = {"boolean": "true, false", "string": "text", "object": "table", "null": ""}
WIDEST = 24  # characters of what a value may be; more choices stand in the meaning
BY_PARAMETER = ("parameters", "free", "start")  # tables whose keys are those of the parameters


def as_text(schema: Content, width: int) -> str:
    """The keys for a terminal with this many columns."""
    return wrapped(_table(schema), width)


def as_markdown(schema: Content) -> str:
    """The keys as a table in Markdown."""
    return markdown(_table(schema))


def _table(schema: Content) -> Table:
    return [HEADING, *_rows(schema)]


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
