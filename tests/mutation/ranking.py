"""Which tests are asked about a mutant: the likeliest to catch it for their time first."""

import functools
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

# By wing: the folders and files of tests that use it, from near to far.
RINGS = {
    "analysis": ["analysis", "report", "studies"],
    "batching": ["batching", "pipeline"],
    "bench": ["bench"],
    "cli": ["cli", "studies"],
    "datasets": ["datasets", "fuzz", "test_data.py"],
    "experiments": ["experiments", "studies", "cli"],
    "inference": ["inference", "problem", "studies"],
    "jobs": ["test_jobs.py", "cli", "studies"],
    "maths": ["maths", "solvers", "world", "stages", "experiments", "pipeline"],
    "pipeline": ["pipeline", "batching", "stages", "problem", "experiments"],
    "presets": ["experiments", "stages", "pipeline"],
    "problem": ["problem", "inference", "experiments", "studies"],
    "record": ["cli/test_record_command.py", "experiments/test_parameter_files.py", "pipeline"],
    "report": ["report", "studies", "viewer"],
    "runtime": ["runtime", "cli", "studies"],
    "solvers": ["solvers", "stages", "pipeline"],
    "stages": ["stages", "pipeline", "experiments"],
    "studies": ["studies", "cli", "report"],
    "viewer": ["viewer"],
    "world": ["world", "datasets", "stages", "batching", "pipeline"],
}
# By module or folder of the package: files about it that do not bear its name, and those that
# compare all systems with their references.
SYSTEMS = [f"pipeline/test_pipeline{name}.py" for name in ("", "_systems", "_stride")]
NEAR = {
    "maths/parameter_tree": ["stages/test_declarations.py"],
    "pipeline": SYSTEMS,
    "presets": [*SYSTEMS, "stages/test_declarations.py"],
    "stages": [*SYSTEMS, "stages/test_declarations.py"],
    "pipeline/phases": ["pipeline/test_tracks.py", "pipeline/test_shapes.py"],
    "pipeline/simulation": ["pipeline/test_shapes.py", "pipeline/test_preconditions.py"],
    "pipeline/system": ["pipeline/test_shapes.py", "pipeline/test_tracks.py"],
    "record": ["pipeline/test_record.py"],
    "solvers/rotations": ["solvers/test_two_bone.py", "solvers/test_aim.py"],
    "stages/effector": ["stages/test_heel.py", "stages/test_rules.py"],
    "stages/foot": ["stages/test_foot_angles.py", "stages/test_rules.py"],
    "stages/lean": ["stages/test_spine_lean.py", "stages/test_rules.py"],
    "stages/leg": ["stages/test_rules.py"],
    "stages/lock": ["stages/test_lock.py", "stages/test_rules.py"],
    "stages/pelvis": ["stages/test_rules.py", "stages/test_game_measures.py"],
    "stages/probe": ["stages/test_limits.py", "stages/test_narrow_ground.py"],
    "stages/probe/capsule": ["stages/test_sweep_probe.py"],
    "stages/probe/stride": ["stages/test_stride_probe.py"],
    "stages/target": ["stages/test_rules.py"],
    "stages/warp": ["stages/test_stride_warp.py"],
    "world/arguments": ["world/test_terrain.py", "world/test_heightfield.py"],
    "world/cells": ["world/test_terrain.py"],
    "world/frame": ["pipeline/test_platforms.py", "pipeline/test_shapes.py"],
    "world/grid": ["world/test_terrain.py"],
    "world/surfaces": ["world/test_terrain.py", "world/test_moving_terrain.py"],
    "world/sweep": ["world/test_sweep.py", "stages/test_sweep_probe.py"],
    "world/terrain": ["world/test_terrain.py"],
}
SECONDS = {False: 10.0, True: 60.0}  # of what has never been run, by whether it is slow
COLLECTION = 0.5  # seconds that it takes to find the tests of a file
# What a file about the module counts for before it has caught anything; one about its folder
# counts for half of that, one about the folder of that for a third.
NEAR_CATCHES = 20.0


class Group(NamedTuple):
    """The tests of a file that are marked as slow, or those that are not."""

    file: str  # from the root of the checkout
    slow: bool


def groups_of(root: Path, module: str) -> Iterator[Group]:
    """The groups of tests that are asked about a module, those of nearer folders first."""
    places = [root / "tests" / name for name in RINGS[wing_of(module)]]
    paths = [
        path
        for place in places
        for path in ([place] if place.is_file() else sorted(place.glob("test_*.py")))
    ]
    files = [path.relative_to(root).as_posix() for path in paths]
    for file in dict.fromkeys([*files, *importers(root, module)]):
        yield from (Group(file, slow) for slow in (False, True))


@functools.cache
def importers(root: Path, module: str) -> list[str]:
    """Files of tests that import a module by its own name, from the root of the checkout."""
    path = Path(module).with_suffix("")
    package, name = re.escape(".".join(path.parent.parts)), path.name
    pattern = re.compile(
        rf"^\s*(?:from {package}\.{name} |import {package}\.{name}\b"
        rf"|from {package} import (?:[\w, ]*|\([\w,\s]*)\b{name}\b)",
        re.MULTILINE,
    )
    files = sorted((root / "tests").rglob("test_*.py"))
    texts = {file: file.read_text(encoding="utf-8") for file in files}
    return [x.relative_to(root).as_posix() for x, text in texts.items() if pattern.search(text)]


def wing_of(module: str) -> str:
    """The folder of the package in which a module is, or its own name at the top."""
    return Path(Path(module).parts[1]).stem


def ranked(
    module: str,
    groups: Iterable[Group],
    seconds: Mapping[Group, float],
    catches: Mapping[Group, int],
    users: Iterable[str] = (),
) -> list[Group]:
    """Groups of tests in the order in which they run: by likely catches per second.

    Args:
        module: that has a mutant.
        groups: those that `groups_of` returns.
        seconds: CPU time that each took, as far as that is known.
        catches: how many mutants of this module each has caught.
        users: files that import the module by its name, which count as being about it.
    """
    listed = list(groups)
    folders = list(dict.fromkeys(Path(group.file).parent for group in listed))
    near = near_files(module) | dict.fromkeys(users, 0)

    def promise(group: Group) -> float:
        steps = near.get(group.file)
        if steps is None:
            prior = 1.0 / (1 + folders.index(Path(group.file).parent))
        else:
            prior = NEAR_CATCHES / (1 + steps)
        return (prior + catches.get(group, 0)) / duration(group, seconds)

    return sorted(listed, key=promise, reverse=True)


def near_files(module: str) -> dict[str, int]:
    """Files of tests about a module or a folder that it is in, and how many folders up that is.

    The files are given from the root of the checkout.
    """
    path = Path(*Path(module).parts[1:]).with_suffix("")
    near = {f"tests/{wing_of(module)}/test_{path.stem}.py": 0}
    for steps, place in enumerate((path, *path.parents)):
        for name in NEAR.get(place.as_posix(), []):
            near.setdefault(f"tests/{name}", steps)
    return near


def duration(group: Group, seconds: Mapping[Group, float]) -> float:
    """CPU seconds that a group of tests takes, or a guess."""
    return COLLECTION + seconds.get(group, SECONDS[group.slow])


def first_part(
    groups: list[Group], seconds: Mapping[Group, float], budget: float
) -> tuple[list[Group], list[Group]]:
    """The groups that are run within so many CPU seconds, at least one, and the others."""
    total, count = 0.0, 0
    for group in groups:
        total += duration(group, seconds)
        if count and total > budget:
            break
        count += 1
    return groups[:count], groups[count:]
