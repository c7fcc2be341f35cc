"""Generated JavaScript under node, as tests run it."""

# pyright: reportArgumentType=false

import math
import shutil
import subprocess
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import jaxik
from fitting.codegen.memory import doubles
from fitting.codegen.program import Program
from fitting.codegen.toolchain import Outputs
from jaxik.pipeline.requests import Request
from jaxik.world.terrain import Hit

NODE = shutil.which("node")
needs_node = pytest.mark.skipif(NODE is None, reason="needs node, which is not installed")
RAY = 8  # numbers
PLAY = """\
import { readFileSync, writeFileSync } from "node:fs";
import * as system from "./NAME.mjs";

const file = readFileSync("inputs.bin");
const numbers = new Float64Array(file.buffer.slice(file.byteOffset, file.byteOffset + file.length));
const { parameters, rig, state, frame, work, rays, hits, result } = system.create();
let place = 0;
const fill = (array) => array.set(numbers.subarray(place, (place += array.length)));
[parameters, rig].forEach(fill);
system.init(parameters, rig, state);
const outputs = [];
while (place < numbers.length) {
  [frame, hits].forEach(fill);
  if (STARTS) fill(state);
  for (let i = 1; i <= system.ROUNDS; i++) {
    system[`rays_${i}`](parameters, rig, state, frame, ...(i > 1 ? [hits] : []), work, rays);
  }
  system.step(parameters, rig, state, frame, ...(system.ROUNDS ? [hits] : []), work, result);
  for (const array of [state, rays, result]) outputs.push(new Uint8Array(array.slice().buffer));
}
writeFileSync("outputs.bin", Buffer.concat(outputs));
"""


def run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """A command of node in a folder."""
    return subprocess.run([str(NODE), *words], cwd=folder, capture_output=True, text=True)


def played(
    program: Program,
    folder: Path,
    name: str,
    setup: tuple[jaxik.FootIK, jaxik.Rig],
    frames: Any,
    hits: Hit,
    starts: jaxik.State | None = None,
) -> Outputs:
    """What the module of a program makes of frames; for the arguments see `Playback`."""
    parts = [
        part for part in (hits.point, hits.normal, hits.found, hits.platform) if part is not None
    ]
    in_order = doubles(
        [np.asarray(part)[:, program.order].reshape(-1, *part.shape[2:]) for part in parts]
    )
    count = len(jax.tree.leaves(frames)[0])
    blocks = [doubles(frames), in_order.reshape(count, -1)]
    blocks += [] if starts is None else [doubles(starts)]
    head = [doubles(jax.tree.map(lambda leaf: np.asarray(leaf)[None], tree)) for tree in setup]
    inputs = [*(block.ravel() for block in head), np.concatenate(blocks, axis=1).ravel()]
    (folder / "inputs.bin").write_bytes(np.concatenate(inputs).tobytes())
    script = PLAY.replace("NAME", name).replace("STARTS", str(starts is not None).lower())
    (folder / "play.mjs").write_text(script)
    done = run(folder, "play.mjs")
    assert done.returncode == 0, done.stderr
    numbers = np.frombuffer((folder / "outputs.bin").read_bytes()).reshape(count, -1)
    ends = np.cumsum([len(program.places["state"]), RAY * program.ray_count])
    states, rays, results = np.split(numbers, ends, axis=1)
    rays = rays.reshape(count, -1, RAY)
    return Outputs(
        _tree(states, program.trees["state"]),
        Request(rays[..., :3], -rays[..., 3:6], rays[..., 6], rays[..., 7]),
        _tree(results, program.trees["result"]),
    )


def _tree(numbers: np.ndarray, like: Any) -> Any:
    """The tree of these structs, in the types of one that is like them."""
    leaves, structure = jax.tree.flatten(like)
    sizes = [math.prod(leaf.shape) for leaf in leaves]
    parts = np.split(numbers, np.cumsum(sizes)[:-1], axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        typed = [
            part.astype(leaf.dtype).reshape(len(numbers), *leaf.shape)
            for part, leaf in zip(parts, leaves, strict=True)
        ]
    return jax.tree.unflatten(structure, typed)
