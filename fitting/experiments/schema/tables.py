"""JSON Schema of tables whose keys are all known."""

import math
from collections.abc import Mapping

from fitting.runtime.validation import Constraint, Content


def closed(properties: Mapping[str, Content], patterns: Mapping[str, Content] = {}) -> Content:  # noqa: B006
    """The schema of a table with these keys and no others.

    Args:
        properties: schemas of the values, by key.
        patterns: likewise, by pattern of further keys.
    """
    schema = {"type": "object", "properties": properties, "additionalProperties": False}
    return schema | {"patternProperties": patterns} if patterns else schema


def named(
    constraints: Mapping[str, Constraint], defaults: Mapping[str, object] | None = None
) -> Content:
    """The schema of a table with these keys and no others.

    Args:
        constraints: of the values, by key.
        defaults: values that keys have where they are left out; None is no value.
    """
    properties = {key: dict(constraint.schema) for key, constraint in constraints.items()}
    for key, default in (defaults or {}).items():
        if key not in properties or default is None or isinstance(default, Mapping):
            continue
        if default == math.inf:  # which JSON does not have
            properties[key]["description"] += " Default: inf."
        else:
            properties[key]["default"] = list(default) if isinstance(default, tuple) else default
    return closed(properties)
