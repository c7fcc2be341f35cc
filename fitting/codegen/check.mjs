// Replays a golden trace, whose numbers come from jaxik.step in Python:
//
//     node check.mjs trace.bin
//
// It ends with 0 if rays and results are as in the trace, but for rounding, which may turn a
// decision on its edge in one frame of fifty.
import { readFileSync } from "node:fs";
import { create, @NAMES } from "./@file.mjs";

const file = readFileSync(process.argv[2] ?? "trace.bin");
const trace = new Float64Array(file.buffer.slice(file.byteOffset, file.byteOffset + file.length));
const { parameters, rig, state, frame, work, rays, hits, result } = create();
let place = 0, frames = 0, worst = 0, turned = 0; // numbers read, frames, difference, decisions

function next(array) {
  place += array.length;
  return trace.subarray(place - array.length, place);
}

function compare(ours, theirs) {
  ours.forEach((number, i) => {
    if (Object.is(number, theirs[i]) || number === theirs[i]) return;
    if (number + theirs[i] === 1 && number * theirs[i] === 0) turned++;
    else worst = Math.max(worst, Math.abs(number - theirs[i])); // NaN stays NaN
  });
}

parameters.set(next(parameters));
rig.set(next(rig));
init(parameters, rig, state);
for (; place < trace.length; frames++) {
  frame.set(next(frame));
  const wanted = next(rays);
  hits.set(next(hits));
@CALLS
  compare(rays, wanted);
  compare(result, next(result));
}
console.log(`${frames} frames, largest difference ${worst.toPrecision(3)}, ${turned} other decisions`);
process.exit(frames > 0 && worst <= 1e-4 && turned <= Math.ceil(frames / 50) ? 0 : 1);
