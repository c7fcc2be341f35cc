// What is drawn beside the skeletons: trails of balls, and what a system senses and wants.

const TRAIL = 1; // s, before and after the moment that is shown
const THIN = 0.006; // m, radius of a line for an adult
const STEP = 0.012; // m, between points of a trail

// A capsule as the stage takes it.
function addCapsule(fields, start, end, colour, opacity, radius) {
  fields.push(...start, ...end, ...colour, opacity, radius);
}

class Layers {
  constructor(player) {
    this.player = player;
    this.overlays = {};
    element("trails").addEventListener("change", () => player.request());
    for (const box of document.querySelectorAll("[data-layer]")) {
      box.addEventListener("change", () => (player.live?.update(), player.request()));
    }
  }

  // Names of those that are to be solved.
  get names() {
    return [...document.querySelectorAll("[data-layer]:checked")].map((box) => box.dataset.layer);
  }

  // Capsules for the stage at a time in frames.
  capsules(time) {
    const fields = [], { player } = this, { palette, clip } = player, radius = THIN * clip.size;
    if (element("trails").checked) {
      for (const skeleton of player.skeletons) {
        const isDrawn = player.shown.has(skeleton.key) && (skeleton === player.watched || skeleton === player.measuring.captured);
        if (isDrawn) skeleton.soles.forEach(([, ball]) => this.addTrail(fields, skeleton, ball, time, radius));
      }
    }
    const frame = Math.min(Math.round(time), clip.frames - 1);
    for (const name of this.names) {
      const { points, colours, lines } = this.overlays[name] ?? { lines: 0 };
      for (let line = lines * frame; line < lines * (frame + 1); line++) {
        const ends = points.subarray(6 * line, 6 * line + 6), [r, g, b] = colours.subarray(3 * line, 3 * line + 3);
        const start = ends.subarray(0, 3), end = ends.subarray(3);
        if (start.every((value, axis) => value === end[axis])) continue;
        addCapsule(fields, start, end, [r / 255, g / 255, b / 255], 1, radius);
      }
    }
    return new Float32Array(fields);
  }

  addTrail(fields, skeleton, ball, time, radius) {
    const { rate, frames, size } = this.player.clip, colour = this.player.palette[skeleton.key];
    const first = Math.max(Math.ceil(time - TRAIL * rate), 0), last = Math.min(Math.floor(time + TRAIL * rate), frames - 1);
    const place = (frame) => [0, 1, 2].map((axis) => skeleton.at(frame, 3 * ball + axis));
    let before = place(first);
    for (let frame = first + 1; frame <= last; frame++) {
      const here = place(frame);
      if (Math.hypot(...subtract(here, before)) < STEP * size && frame < last) continue;
      addCapsule(fields, before, here, colour, 1, radius);
      before = here;
    }
  }

  // Takes the lines of a solution: (frames, lines) with two ends and a colour each.
  take(solution) {
    this.overlays = {};
    for (const [name, lines] of Object.entries(solution?.layers ?? {})) {
      this.overlays[name] = { lines, points: solution[`${name} points`], colours: solution[`${name} colours`] };
    }
  }
}
