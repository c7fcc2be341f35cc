"""Tables of settings as files: TOML, JSON and CSV.

TOML and JSON have the name of the original, the settings, and their units where they have one:

system = "unreal"
[settings]
m_IKTraceDistance = 50.0
[units]
m_IKTraceDistance = "cm"

CSV has a row for each setting, with the columns system, setting, value and unit.
"""

import contextlib
import csv
import io
import json
from collections.abc import Mapping
from pathlib import Path

import tomli_w

import jaxik
from fitting.runtime import validation
from fitting.runtime.validation import TABLE, TEXT, Content, check_table

from .conversion import Value, original_of, to_ik

COLUMNS = ["system", "setting", "value", "unit"]
KEYS = {"system": TEXT, "settings": TABLE, "units": TABLE}
SUFFIXES = (".toml", ".json", ".csv")


def settings_text(values: Mapping[str, Value], name: str, suffix: str) -> str:
    """A table of settings.

    Args:
        values: as `to_settings` returns them.
        name: of the original.
        suffix: of the file, one of `SUFFIXES`.
    """
    units = {setting.name: setting.unit.name for setting in original_of(name).settings}
    if suffix == ".csv":
        out = io.StringIO()
        rows = csv.writer(out, lineterminator="\n")
        rows.writerow(COLUMNS)
        rows.writerows([name, key, json.dumps(value), units[key]] for key, value in values.items())
        return out.getvalue()
    named = {key: unit for key, unit in units.items() if unit not in ("", "1")}
    content = {"system": name, "settings": dict(values), "units": named}
    return json.dumps(content, indent=1) + "\n" if suffix == ".json" else tomli_w.dumps(content)


def has_settings(path: Path) -> bool:
    """Whether a file looks like a table of settings rather than anything else."""
    if validation.why_unreadable(path) or path.suffix.lower() not in SUFFIXES:
        return False
    with contextlib.suppress(ValueError):
        return "settings" in _read(path)
    return False


def load_settings(path: Path) -> tuple[jaxik.FootIK, str]:
    """The system in a table of settings, and the name of its original.

    Raises:
        ValueError: the file does not exist or is no such table; a setting is unknown, has another
            unit than the original's, or a value that it cannot have.
    """
    if reason := validation.why_unreadable(path):
        raise ValueError(f"{path}: {reason}, wanted a table of settings")
    with validation.error_context(path):
        content = _read(path)
        check_table(content, KEYS, "a table of settings")
        if missing := [key for key in ("system", "settings") if key not in content]:
            raise ValueError(f"no table of settings: there is no {missing[0]}")
        name, units = content["system"], content.get("units", {})
        own = {setting.name: setting.unit.name for setting in original_of(name).settings}
        for setting, unit in units.items():
            if unit != own.get(setting, unit):
                raise ValueError(f"{setting} is in {unit!r}; {name} has it in {own[setting]!r}")
        return to_ik(content["settings"], name), name


def _read(path: Path) -> Content:
    if path.suffix.lower() == ".toml":
        return validation.read_toml(path, "a settings")
    if path.suffix.lower() == ".json":
        content = validation.read_json(path)
        return content if isinstance(content, dict) else {}
    try:
        rows = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8"))))
    except csv.Error as error:
        raise ValueError(f"no table of settings: {error}") from None
    if not rows or rows[0] != COLUMNS or any(len(row) != len(COLUMNS) for row in rows):
        raise ValueError(f"no table of settings; wanted the columns {COLUMNS}")
    if len(systems := {row[0] for row in rows[1:]}) != 1:
        raise ValueError(f"settings of {sorted(systems)}; wanted those of one system")
    try:
        settings = {name: json.loads(value) for _, name, value, _ in rows[1:]}
    except RecursionError:
        raise ValueError("no table of settings: a value is nested too deeply") from None
    units = {name: unit for _, name, _, unit in rows[1:]}
    return {"system": systems.pop(), "settings": settings, "units": units}
