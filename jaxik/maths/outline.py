"""Trees of rules as people read them: text for a terminal, a table for a notebook."""

import dataclasses
import html
from collections.abc import Callable, Iterable, Iterator

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer

MOST_SHOWN = 8  # numbers of one leaf that are printed one by one
ALL_LAYERS = 0xFFFFFFFF


def outline(module: eqx.Module) -> str:
    """A tree of rules as aligned text: stage, rule, and each parameter with its unit."""
    return "\n".join([type(module).__name__, *_outlined(module, "  ")])


def _outlined(module: eqx.Module, indent: str) -> Iterator[str]:
    fields = dataclasses.fields(module)
    width = max((len(field.name) for field in fields), default=0)
    for field in fields:
        value = getattr(module, field.name)
        head = f"{indent}{field.name:<{width}}  "
        if isinstance(value, eqx.Module):
            yield head + type(value).__name__
            yield from _outlined(value, f"{indent}  ")
        else:
            yield head + value_text(value, field.metadata.get("unit", ""))


def table(module: eqx.Module) -> str:
    """A tree of rules as an HTML table: value, range and meaning of each parameter."""
    head = _row("th", (type(module).__name__, "value", "range", "meaning"))
    return f"<table>{head}{''.join(_rows(module, ''))}</table>"


def _rows(module: eqx.Module, path: str) -> Iterator[str]:
    for field in dataclasses.fields(module):
        value, name = getattr(module, field.name), f"{path}{field.name}"
        if isinstance(value, eqx.Module):
            yield _row("th", (name, type(value).__name__, "", ""))
            yield from _rows(value, f"{name}.")
        else:
            declared = field.metadata.get("declaration")
            limits = f"{declared.low:.4g} to {declared.high:.4g}" if declared else ""
            text = value_text(value, field.metadata.get("unit", ""))
            yield _row("td", (name, text, limits, field.metadata.get("doc", "")))


def _row(tag: str, cells: Iterable[str]) -> str:
    style = ' style="text-align: left"'
    return f"<tr>{''.join(f'<{tag}{style}>{html.escape(cell)}</{tag}>' for cell in cells)}</tr>"


def value_text(value: object, unit: str) -> str:
    """A leaf's value and unit; its type and shape where it is a tracer, or many numbers."""
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, Tracer) or not isinstance(value, jax.Array | np.ndarray):
        return eqx.tree_pformat(value)
    if value.size > MOST_SHOWN:
        return f"{eqx.tree_pformat(value)} {unit}".rstrip()
    numbers = np.asarray(value)
    if numbers.dtype == bool:
        return _listed(numbers, lambda on: "on" if on else "off")
    if numbers.dtype == np.uint32:
        return _listed(numbers, lambda mask: "all" if mask == ALL_LAYERS else f"{mask:#x}")
    text = _listed(numbers, "{:.4g}".format)
    if unit == "rad":
        return f"{text} rad ({_listed(np.asarray(np.degrees(numbers)), '{:.4g}°'.format)})"
    return text if unit == "1" else f"{text} {unit}".rstrip()


def _listed(numbers: np.ndarray, show: Callable) -> str:
    """Numbers as text: one alone, more in brackets."""
    parts = [_listed(np.asarray(part), show) for part in numbers] if numbers.ndim else []
    return f"[{', '.join(parts)}]" if numbers.ndim else show(numbers[()])
