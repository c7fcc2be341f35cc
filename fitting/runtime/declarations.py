"""Tables of files, each declared once, as a dataclass: checked, read and shown as JSON Schema.

    @dataclass(frozen=True)
    class Foot(Table):
        kind: Literal["left", "right"] = key(NEEDED, "Which foot.")
        height: float | None = key(None, "Of the ankle; left out, measured.", "m", 0, 10)

The type of a field says what stands under its key: `bool`, a text as `str` or `Path`, one of the
words of a `Literal`, a number in a range, a list as `tuple`, a table as another such class or a
mapping, or what a `Constraint` in `Annotated` says. Fields without `key` stand in no file.
"""

import dataclasses
import functools
import math
import sys
import types
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from .validation import Content, check_keys, error_context
from .validation import Table as Entries

LONGEST_TEXT = 1000
LARGEST = 3.4e38  # that 32 bits hold
# JSON has no infinity: some validators read inf as a number above all others, Taplo as null.
INFINITE = ({"type": "number", "exclusiveMinimum": sys.float_info.max}, {"type": "null"})
NEEDED = dataclasses.MISSING
IN_WORDS = {"s": "seconds", "m": "metres", "Hz": "Hz"}  # units that sentences name

Declared = TypeVar("Declared")


@dataclasses.dataclass(frozen=True)
class Constraint:
    """What a value must be: in words for error messages, as a test, and as JSON Schema."""

    description: str
    accepts: Callable[[Any], bool]
    schema: Entries = dataclasses.field(default_factory=dict, compare=False)
    """As much of it as JSON Schema can say: what that allows may still be refused."""
    convert: Callable[[Any], Any] = lambda value: value
    """From what a file holds to what code expects, of values that are accepted."""


class Key(NamedTuple):
    """What is declared of one key."""

    constraint: Constraint
    meaning: str
    """A sentence."""
    unit: str = ""
    default: Any = None
    inner: type | None = None
    """The declaration of the table, or of the tables in a list, that stand under it."""

    @property
    def schema(self) -> Content:
        """Of its value, with meaning and unit."""
        notes = {
            "Needed.": self.default is NEEDED,
            "The path is relative.": self.constraint is PATH,
            f"Unit: {self.unit}.": self.unit,
        }
        description = " ".join([self.meaning, *(note for note in notes if notes[note])])
        return {**self.constraint.schema, "description": description}


def key(
    default: Any,
    meaning: str,
    unit: str = "",
    low: int | float | None = None,
    high: int | float | None = None,
    *,
    wanted: str = "",
) -> Any:
    """A field that is a key of a table in a file.

    Args:
        default: its value where the key is left out; `NEEDED` where it may not be.
        meaning: one sentence.
        unit: of the value; empty for a ratio or a word.
        low: with `high`, the range of the number, or of each number of a list.
        high: its upper end.
        wanted: what the value must be, in words; empty takes those of the type.
    """
    field: Any = dataclasses.field
    value = {"default_factory": dict} if default == {} else {"default": default}
    return field(**value, metadata={"key": (meaning, unit, low, high, wanted)})


@functools.cache
def keys(table: type) -> dict[str, Key]:
    """The keys that a dataclass declares, in the order of its fields; those of its bases last."""
    hints, declared = get_type_hints(table, include_extras=True), {}
    for field in sorted(dataclasses.fields(table), key=lambda field: field.kw_only is True):
        if "key" in field.metadata:
            meaning, unit, low, high, wanted = field.metadata["key"]
            constraint, inner = _declared(hints[field.name], low, high, IN_WORDS.get(unit, ""))
            if wanted:
                constraint = dataclasses.replace(constraint, description=wanted)
            is_mapping = field.default_factory is dict
            default = {} if is_mapping else field.default
            declared[field.name] = Key(constraint, meaning, unit, default, inner)
    return declared


def _declared(
    hint: Any, low: int | float | None, high: int | float | None, unit: str
) -> tuple[Constraint, type | None]:
    """What a type accepts, and the declaration of the table or tables in it."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return arguments[1], None
    if origin in (Union, types.UnionType):
        options = [each for each in arguments if each is not types.NoneType]
        return _any_of([_declared(each, low, high, unit)[0] for each in options]), None
    if origin is tuple:
        constraint, inner = _declared(arguments[0], low, high, unit)
        size = None if arguments[-1] is ... else len(arguments)
        return list_of(constraint, size), inner
    if isinstance(hint, type) and dataclasses.is_dataclass(hint) and keys(hint):
        return dataclasses.replace(TABLE, schema=table_schema(keys(hint))), hint
    if origin is Literal:
        return one_of(arguments), None
    if hint is int and low is not None and high is not None:
        return count(int(low), int(high)), None
    if hint is float:
        return NUMBER if low is None or high is None else number(low, high, unit), None
    return PLAIN.get(hint, TABLE), None


def is_within(value: object, low: int | float, high: int | float, *, whole: bool = False) -> bool:
    """Whether it is a number in this range, and with `whole` one without a fraction."""
    kinds = int if whole else (int, float)
    return isinstance(value, kinds) and not isinstance(value, bool) and low <= value <= high


def number(
    low: int | float, high: int | float, unit: str = "", *, or_inf: bool = False
) -> Constraint:
    """A number in a range, or with `or_inf` infinity as well."""
    words = f"a number{' of ' if unit else ''}{unit} from {low:g} to {high:g}"
    schema = {"type": "number", "minimum": low, "maximum": high}
    return Constraint(
        f"{words}, or inf" if or_inf else words,
        lambda value: is_within(value, low, high) or (or_inf and value == math.inf),
        {"anyOf": [schema, *INFINITE]} if or_inf else schema,
        float,
    )


def count(low: int, high: int) -> Constraint:
    """A whole number in a range."""
    return Constraint(
        f"a whole number from {low} to {high}",
        lambda value: is_within(value, low, high, whole=True),
        {"type": "integer", "minimum": low, "maximum": high},
    )


def one_of(words: Iterable[Any]) -> Constraint:
    """Any of these values."""
    words = list(words)
    return Constraint(f"one of {words}", lambda value: value in words, {"enum": words})


def list_of(element: Constraint, size: int | None = None) -> Constraint:
    """A list of `size` such elements, or of any number; those that are tables are read later."""
    length = "" if size is None else f" of {size}"

    def accepts(value: object) -> bool:
        if not isinstance(value, list | tuple) or size not in (None, len(value)):
            return False
        return element.accepts is TABLE.accepts or all(map(element.accepts, value))

    return Constraint(
        f"a list{length}, each {element.description}",
        accepts,
        {"type": "array", "items": element.schema}
        | ({} if size is None else {"minItems": size, "maxItems": size}),
        lambda values: tuple(map(element.convert, values)),
    )


def _any_of(options: list[Constraint]) -> Constraint:
    if len(options) == 1:
        return options[0]
    return Constraint(
        " or ".join(option.description for option in options),
        lambda value: any(option.accepts(value) for option in options),
        {"anyOf": [option.schema for option in options]},
        lambda value: next(each.convert(value) for each in options if each.accepts(value)),
    )


def _is_text(value: object) -> bool:
    return isinstance(value, str) and value.isprintable() and len(value) <= LONGEST_TEXT


TEXT = Constraint(
    f"a text of at most {LONGEST_TEXT} printable characters",
    _is_text,
    {"type": "string", "maxLength": LONGEST_TEXT, "pattern": "^[^\\u0000-\\u001f\\u007f]*$"},
)
BOOLEAN = Constraint("true or false", lambda value: isinstance(value, bool), {"type": "boolean"})
TABLE = Constraint("a table", lambda value: isinstance(value, Mapping), {"type": "object"})
NUMBER = dataclasses.replace(number(-LARGEST, LARGEST), description="a finite number")
PATH = dataclasses.replace(TEXT, convert=Path)
PLAIN = {bool: BOOLEAN, str: TEXT, Path: PATH}


def check_table(value: object, known: Mapping[str, Key], where: str) -> Content:
    """The values of a table as code expects them, if each is what its key declares.

    Args:
        value: what was read.
        known: by name.
        where: the table's place in its file, for the error message: "walk.toml [fit]".

    Raises:
        ValueError: it is not a table, lacks a key that is needed, or has an unknown one or a value
            that is not accepted; the message says what came, what was wanted, and which keys there
            are.
    """
    if not isinstance(value, Mapping):
        raise ValueError(f"{where} is {value!r}; wanted a table, such as {{}}")
    check_keys(value, list(known), where)
    for name, entry in value.items():
        if not (wanted := known[name].constraint).accepts(entry):
            raise ValueError(f"{where}: {name} is {entry!r}; wanted {wanted.description}")
    needed = [name for name, declared in known.items() if declared.default is NEEDED]
    if missing := [name for name in needed if name not in value]:
        raise ValueError(f"{where}: {missing[0]} is missing; it needs {' and '.join(needed)}")
    return {name: _value(entry, known[name], name, where) for name, entry in value.items()}


def _value(entry: Any, declared: Key, name: str, where: str) -> Any:
    if declared.inner is None:
        return declared.constraint.convert(entry)
    if isinstance(entry, Mapping):
        return read(entry, declared.inner, f"{where} [{name}]")
    return tuple(read(each, declared.inner, f"{where} [[{name}]]") for each in entry)


def read(value: object, table: type[Declared], where: str) -> Declared:
    """A table as a dataclass; arguments and errors are those of `check_table`."""
    values = check_table(value, keys(table), where)
    with error_context(where):
        return table(**values)


@dataclasses.dataclass(frozen=True)
class Table:
    """Base of declared tables whose values are checked wherever one is made.

    Raises:
        ValueError: for a value that is not what its key declares.
    """

    def __post_init__(self) -> None:
        for name, declared in keys(type(self)).items():
            value, wanted = getattr(self, name), declared.constraint
            if not wanted.accepts(value) and not (value is None and declared.default is None):
                raise ValueError(
                    f"{name} is {value!r}, wanted {wanted.description}: {declared.meaning}"
                )


def changed(table: Any) -> Content:
    """The values of a declared table that are not its defaults, by key."""
    values = {name: (getattr(table, name), entry) for name, entry in keys(type(table)).items()}
    return {name: value for name, (value, entry) in values.items() if value != entry.default}


def closed(properties: Mapping[str, Content], patterns: Mapping[str, Content] = {}) -> Content:  # noqa: B006
    """The schema of a table with these keys and no others.

    Args:
        properties: schemas of the values, by key.
        patterns: schemas of further keys, by pattern.
    """
    schema = {"type": "object", "properties": properties, "additionalProperties": False}
    return schema | {"patternProperties": patterns} if patterns else schema


def table_schema(known: Mapping[str, Key]) -> Content:
    """The schema of a table with these keys and no others."""
    properties = {name: declared.schema for name, declared in known.items()}
    for name, schema in properties.items():
        default = known[name].default
        if default == math.inf:  # which JSON does not have
            schema["description"] += " Default: inf."
        elif isinstance(default, bool | int | float | str) and default != "":
            schema["default"] = default
    needed = [name for name, declared in known.items() if declared.default is NEEDED]
    return closed(properties) | ({"required": needed} if needed else {})
