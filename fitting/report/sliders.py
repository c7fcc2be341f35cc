"""Sliders for the parameters of a system: the live viewer has them, and so have pages."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

import jaxik
from fitting.problem.space import FreeParameter
from jaxik.maths import parameter_tree
from jaxik.world.body import exponent, scaled_declarations

STEPS = 400  # of a slider over its range, at least


@dataclass(frozen=True)
class Slider:
    """One number or switch of a system, or one element of an array of them."""

    name: str
    """Dotted, with [i] for an element."""
    leaf: str
    """Dotted name of the array."""
    index: tuple[int, ...]
    """Of the element; () for a single number."""
    low: float
    """In the parameter's unit."""
    high: float
    unit: str
    meaning: str
    is_switch: bool = False
    above: str | None = None
    """Dotted name of the array that the value stays above."""
    below: tuple[str, ...] = ()
    """Of those that stay above it."""
    is_free: bool = False
    """Whether a fit has changed it."""

    @property
    def step(self) -> float:
        """Of a slider: a round number, in the parameter's unit."""
        raw = (self.high - self.low) / STEPS
        power = 10.0 ** math.floor(math.log10(raw))
        return next(m for m in (5.0, 2.0, 1.0) if m * power <= raw * (1 + 1e-9)) * power

    def scaled(self, ratio: float) -> "Slider":
        """That of a system for a dynamically similar body; see `jaxik.world.body.similar`."""
        factor = ratio ** exponent(self.unit)
        return replace(self, low=factor * self.low, high=factor * self.high)

    def read(self, ik: jaxik.FootIK) -> float | bool:
        """The value that a system has."""
        value = np.asarray(parameter_tree.get(ik, self.leaf))[self.index]
        return bool(value) if self.is_switch else float(value)


def sliders(
    ik: jaxik.FootIK, rig: jaxik.Rig | None = None, free: Sequence[FreeParameter] = ()
) -> list[Slider]:
    """The parameters and switches of a system, stage by stage.

    Args:
        ik: the system.
        rig: on whose body the ranges depend; None is the adult.
        free: parameters of a fit, whose ranges go before those of their rules.
    """
    declared, meanings = scaled_declarations(ik, rig), parameter_tree.docs(ik)
    fitted = {parameter.leaf: parameter for parameter in free}
    above = {
        name: f"{name.rpartition('.')[0]}.{declaration.above}"
        for name, declaration in declared.items()
        if declaration.above is not None
    }
    every = []
    for slot in parameter_tree.slots(ik):
        value = np.asarray(slot.value)
        declaration, is_switch = declared.get(slot.name), value.dtype == bool
        if declaration is None and not is_switch:  # a convention, or a mask of layers
            continue
        own = fitted.get(slot.name, declaration)
        low, high = (0.0, 1.0) if own is None else (own.low, own.high)
        for index in np.ndindex(value.shape):
            every.append(
                Slider(
                    name=slot.name + "".join(f"[{i}]" for i in index),
                    leaf=slot.name,
                    index=index,
                    low=low,
                    high=high,
                    unit=slot.unit,
                    meaning=meanings[slot.name],
                    is_switch=is_switch,
                    above=above.get(slot.name),
                    below=tuple(name for name, other in above.items() if other == slot.name),
                    is_free=slot.name in fitted,
                )
            )
    return every
