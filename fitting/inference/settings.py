"""Settings of the search and of the sampler: numbers with a unit, a range and a meaning.

A settings class is a frozen dataclass derived from `Settings` whose fields are all declared with
`setting`. The declaration is the only place where a default, its range and its meaning stand:
experiment files and error messages read it from there.
"""

import dataclasses
from typing import Any

from fitting.runtime.validation import Content, is_within


@dataclasses.dataclass(frozen=True)
class Setting:
    """What is known of one setting."""

    meaning: str
    """One sentence."""
    unit: str
    """"1" for a ratio."""
    low: int | float
    """Of each number, where there are several."""
    high: int | float
    integer: bool
    several: bool = False
    """a tuple of numbers."""
    optional: bool = False
    """None stands for a number that is chosen later."""

    @property
    def range(self) -> str:
        """What a value may be, for error messages."""
        kind = "whole number" if self.integer else "number"
        limits = f" from {self.low:g} to {self.high:g}"
        return f"a list of {kind}s{limits}" if self.several else f"a {kind}{limits}"

    @property
    def schema(self) -> Content:
        """The same as JSON Schema."""
        kind = "integer" if self.integer else "number"
        number = {"type": kind, "minimum": self.low, "maximum": self.high}
        return {"type": "array", "items": number, "minItems": 1} if self.several else number

    def allows(self, value: object) -> bool:
        """Whether a setting may have this value."""
        if self.several:
            values = value if isinstance(value, tuple | list) else ()
            return len(values) > 0 and all(map(self._fits, values))
        return (value is None and self.optional) or self._fits(value)

    def _fits(self, number: object) -> bool:
        return is_within(number, self.low, self.high, whole=self.integer)


def setting(
    default: int | float | tuple[float, ...] | None,
    meaning: str,
    *,
    unit: str = "1",
    low: int | float = 0,
    high: int | float,
) -> Any:
    """A field of a settings class; its kind is that of the default, None meaning an integer."""
    several = isinstance(default, tuple)
    example = default[0] if isinstance(default, tuple) else default
    declared = Setting(
        meaning=meaning,
        unit=unit,
        low=low,
        high=high,
        integer=not isinstance(example, float),
        several=several,
        optional=default is None,
    )
    return dataclasses.field(default=default, metadata={"setting": declared})


@dataclasses.dataclass(frozen=True)
class Settings:
    """Base of settings classes; checks every value when one is made.

    Raises:
        ValueError: for a setting out of its range.
    """

    def __post_init__(self) -> None:
        for name, declared in describe(type(self)).items():
            value = getattr(self, name)
            if not declared.allows(value):
                raise ValueError(
                    f"{name} is {value!r}, wanted {declared.range}: {declared.meaning}"
                )


def describe(settings: type[Settings]) -> dict[str, Setting]:
    """The settings of a class by name, in the order of its fields."""
    return {field.name: field.metadata["setting"] for field in dataclasses.fields(settings)}
