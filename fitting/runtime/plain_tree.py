"""Trees as JSON: plain values, containers, dataclasses and named functions.

    null, true, 3, 0.5, "text"                       as they are
    ["list", ...], ["tuple", ...]                    items
    ["dict", [key, value], ...]                      sorted by key
    ["namedtuple", "module:Class", ...]              items
    ["object", "module:Class", {"field": ...}]       a dataclass or an Equinox module
    ["name", "module:name"]                          a function or a class

Equal trees have equal JSON in every process. Reading imports nothing and calls nothing: it takes
classes of this project and of the libraries below from modules that are already imported, and sets
the fields of their instances.
"""

import dataclasses
import json
import sys
from typing import Any, TypeAlias

PROJECT = ("jaxik", "fitting")
LIBRARIES = ("jax", "jaxlib", "equinox", "lineax", "optimistix", "numpy")
NAMED = {*PROJECT, *LIBRARIES, *sys.stdlib_module_names}  # what may be written down by its name
READ = {*PROJECT, "equinox", "optimistix"}  # whose classes may be read

Json: TypeAlias = Any  # what the module `json` reads and writes


class NotPlainError(TypeError):
    """A tree holds something that this JSON cannot express, such as a user's own function."""


def describe(tree: object) -> Json:
    """The JSON of a tree.

    Raises:
        NotPlainError: it holds anything else than the module's docstring lists.
    """
    if tree is None or isinstance(tree, bool | int | float | str):
        return tree
    if type(tree) in (list, tuple):
        return [type(tree).__name__, *map(describe, tree)]  # type: ignore[call-overload]
    if isinstance(tree, dict):
        pairs = ([describe(key), describe(value)] for key, value in tree.items())
        return ["dict", *sorted(pairs, key=lambda pair: json.dumps(pair[0]))]
    if _is_namedtuple(type(tree)):
        return ["namedtuple", _path(type(tree)), *map(describe, tree)]  # type: ignore[call-overload]
    if callable(tree) and hasattr(tree, "__qualname__"):
        return ["name", _path(tree)]
    if dataclasses.is_dataclass(tree):
        fields = {name: describe(getattr(tree, name)) for name in _field_names(type(tree))}
        return ["object", _path(type(tree)), fields]
    raise NotPlainError(f"{type(tree).__qualname__} is neither a plain value nor a dataclass")


def rebuild(description: Json) -> object:
    """The tree that a description was made from; functions and classes are not read back.

    Raises:
        ValueError: this is not a description, or it names a class that may not be read.
    """
    match description:
        case None | bool() | int() | float() | str():
            return description
        case ["list", *items]:
            return [rebuild(item) for item in items]
        case ["tuple", *items]:
            return tuple(rebuild(item) for item in items)
        case ["dict", *pairs]:
            return {rebuild(key): rebuild(value) for key, value in pairs}
        case ["namedtuple", str(path), *items]:
            return _new_namedtuple(_find_class(path), [rebuild(item) for item in items])
        case ["object", str(path), dict(fields)]:
            values = {name: rebuild(value) for name, value in fields.items()}
            return _new_object(_find_class(path), values)
    raise ValueError(f"{str(description)[:60]!r} describes no tree")


def _path(named: Any) -> str:
    """Where a class or function is found by its name.

    Raises:
        NotPlainError: it is not, or its source is the user's and may change under this name.
    """
    module, name = named.__module__, named.__qualname__
    if str(module).partition(".")[0] not in NAMED or _lookup(module, name) is not named:
        raise NotPlainError(f"{module}.{name} is not known by its name")
    return f"{module}:{name}"


def _lookup(module: str, name: str) -> object:
    """What a module holds under a dotted name; None if nothing. Runs no code of what it finds."""
    holder: object = sys.modules.get(module)
    for part in name.split("."):
        holder = getattr(holder, "__dict__", {}).get(part)
    return holder


def _find_class(path: str) -> type:
    module, _, name = path.partition(":")
    named = _lookup(module, name)
    if module.partition(".")[0] not in READ or not isinstance(named, type):
        raise ValueError(f"{path} is not a class of {', '.join(sorted(READ))}")
    return named


def _new_namedtuple(cls: type, items: list[object]) -> object:
    if not _is_namedtuple(cls) or len(items) != len(cls._fields):  # type: ignore[attr-defined]
        raise ValueError(f"{cls.__qualname__} is not a named tuple of {len(items)} items")
    return tuple.__new__(cls, items)


def _new_object(cls: type, values: dict[str, object]) -> object:
    if not dataclasses.is_dataclass(cls) or set(values) != set(_field_names(cls)):
        raise ValueError(f"{cls.__qualname__} is not a dataclass of the fields {sorted(values)}")
    instance = object.__new__(cls)
    for name, value in values.items():
        object.__setattr__(instance, name, value)
    return instance


def _is_namedtuple(cls: type) -> bool:
    return issubclass(cls, tuple) and hasattr(cls, "_fields")


def _field_names(cls: type) -> list[str]:
    return [field.name for field in dataclasses.fields(cls)]
