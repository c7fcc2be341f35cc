"""Experiment files for tests: the embedded walk, or a second of it, with few parameters free."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
UNEVEN_WALK = ROOT / "data" / "experiments" / "uneven_walk.toml"
CLIP = f"""
[[clips]]
reference = "{ROOT}/data/clips/uneven_walk.npz"
base = "{ROOT}/data/clips/uneven_walk_base.npz"
terrain = "{ROOT}/data/terrains/uneven_walk.ply"
"""
SECOND = "start = 1.0\nend = 2.0\n"
FREE = """
pelvis.on_gain = {}
foot.max_pitch = { low = 0.1 }
"""


def text(
    top: str = "", clip: str = "", free: str = FREE, rest: str = "", clips: str = CLIP + SECOND
) -> str:
    """An experiment as TOML, valid unless a part makes it wrong."""
    return f"{top}\n{clips}{clip}\n[free]\n{free}\n{rest}\n"


def write(folder: Path, name: str = "experiment.toml", **parts: str) -> Path:
    """The file of an experiment; `parts` as in `text`."""
    path = folder / name
    path.write_text(text(**parts), encoding="utf-8")
    return path
