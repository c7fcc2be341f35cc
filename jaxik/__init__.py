"""Foot IK as pure, jittable JAX functions over batched legs.

What is named here is imported when it is first asked for: importing `jaxik` costs next to nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from . import presets as presets
    from . import record as record
    from .frame import Frame as Frame
    from .gate import HARD as HARD
    from .gate import Hard as Hard
    from .gate import Smooth as Smooth
    from .many import lanes as lanes
    from .pipeline import FootIK as FootIK
    from .pipeline import Result as Result
    from .pipeline import State as State
    from .pipeline import init as init
    from .pipeline import resume as resume
    from .pipeline import run as run
    from .pipeline import step as step
    from .skeleton import LegPose as LegPose
    from .skeleton import Rig as Rig
    from .skeleton import Transform as Transform

_NAMES = {
    "frame": ("Frame",),
    "gate": ("HARD", "Hard", "Smooth"),
    "many": ("lanes",),
    "pipeline": ("FootIK", "Result", "State", "init", "resume", "run", "step"),
    "skeleton": ("LegPose", "Rig", "Transform"),
}
_ROOMS = {name: room for room, names in _NAMES.items() for name in names}


def __getattr__(name: str) -> Any:
    """A name of the face, or a module of the package."""
    try:
        room = import_module(f".{_ROOMS.get(name, name)}", __name__)
    except ModuleNotFoundError as error:
        if error.name != f"{__name__}.{name}":
            raise  # a module that is there needs one that is not
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}") from None
    found = getattr(room, name) if name in _ROOMS else room
    globals()[name] = found  # asked once
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *_ROOMS, "presets", "record"})
