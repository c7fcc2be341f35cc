// A worker that solves a clip again, with the system as a script.

// Bytes that live_data.py has compressed.
async function unpacked(text) {
  const stream = new Blob([bytesOf(text)]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}
const doubles = async (text) => new Float64Array(await unpacked(text));
const integers = async (text) => new Uint32Array(await unpacked(text));

// A table of so many columns, row by row, of which live_data.py has packed 6 bytes of each number.
async function table(text, columns) {
  const planes = new Uint8Array(await unpacked(text)), count = planes.length / 6, rows = count / columns;
  const bytes = new Uint8Array(8 * count);
  for (let i = 0; i < planes.length; i++) {
    const place = i % count, row = place % rows, column = (place - row) / rows;
    bytes[8 * (row * columns + column) + 2 + (i - place) / count] = planes[i];
  }
  return new Float64Array(bytes.buffer);
}

// A worker that has the clip that `live` describes; `first` is the animation on the page.
async function workerSolver(live, script, trunk, first, frames) {
  const [code, numbers, measures, observed] = await Promise.all([
    unpacked(script.code), table(live.numbers, live.columns), doubles(live.measures), unpacked(live.observed),
  ]);
  const surfaces = await Promise.all(live.surfaces.map(async (surface) => {
    if (surface.kind === "Heights") return { ...surface, heights: await table(surface.heights, surface.columns) };
    if (surface.kind !== "Mesh") return surface;
    const [vertices, triangles, layers] = await Promise.all([table(surface.vertices, 3), integers(surface.triangles), integers(surface.layers)]);
    return { ...surface, vertices, triangles, layers };
  }));
  const count = 3 * first.points; // of the animation, whose joints move with the solved ones
  const animated = Float32Array.from({ length: count * frames }, (_, i) => first.at(Math.floor(i / count), i % count));
  const worker = new Worker(URL.createObjectURL(new Blob([code], { type: "text/javascript" })));
  const { step, columns, anchors, reach } = live, { pelvis, soles } = first, { layout } = script;
  worker.postMessage({ clip: {
    frames: live.frames, step, columns, anchors, reach, pelvis, soles, layout, trunk, numbers, measures, surfaces, animated,
    observed: new Uint8Array(observed),
  } });
  return worker;
}
