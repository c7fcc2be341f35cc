"""Experiment files for tests: the uneven walk, or a second of it, with two free parameters."""

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
pelvis.half_life = {}
foot.max_pitch = { low = 0.1 }
"""

EVERY_KIND = """[sigmas]
ankle = 0.02
knee = 0.03
pelvis = 0.01
foot = 0.1
body = 0.2
contact = 0.5
smooth = 20.0
correlation = { ankle = 0.4, knee = 0.3, pelvis = 0.9, foot = 0.2, body = 0.1 }
"""


def text(
    top: str = "", clip: str = "", free: str = FREE, rest: str = "", clips: str = CLIP + SECOND
) -> str:
    """An experiment as TOML; valid unless one of the parts is wrong."""
    return f"{top}\n{clips}{clip}\n[free]\n{free}\n{rest}\n"


def write(folder: Path, name: str = "experiment.toml", **parts: str) -> Path:
    """Writes the file of an experiment; `parts` are the arguments of `text`."""
    path = folder / name
    path.write_text(text(**parts), encoding="utf-8")
    return path
