// How far each motion is from the captured one, and how its feet stand: as fitting.motion.accuracy
// and fitting.motion.measures define it, of the frames that the page shows.

const rms = (values) => Math.sqrt(values.reduce((sum, value) => sum + value * value, 0) / values.length);
const rounded = (value, digits) => value.toFixed(digits).replace(/^-(0\.?0*)$/, "$1"); // never -0.00
const COLUMNS = [ // title, unit, digits, meaning
  ["ankles", "cm", 2, "Distance from captured ankles, root mean square"],
  ["standing", "cm", 2, "The same while the foot stands"],
  ["knees", "cm", 2, "Distance from captured knees, root mean square"],
  ["pelvis", "cm", 2, "Difference in height from the captured pelvis, root mean square"],
  ["in the ground", "%", 1, "Frames in which a sole is visibly in the ground"],
  ["slide", "cm", 2, "How far a standing foot slides beyond the animation; median of stances"],
];

function median(values) {
  const sorted = [...values].sort((a, b) => a - b), middle = sorted.length >> 1;
  return sorted.length % 2 ? sorted[middle] : (sorted[middle - 1] + sorted[middle]) / 2;
}

// First and last frames of stretches of marked frames.
function stretches(isMarked, frames) {
  const runs = [];
  for (let frame = 0; frame < frames; frame++) {
    if (!isMarked(frame)) continue;
    const last = runs.at(-1);
    if (last && last[1] === frame - 1) last[1] = frame;
    else runs.push([frame, frame]);
  }
  return runs;
}

class Measuring {
  constructor(clip, skeletons) {
    Object.assign(this, { clip, skeletons });
    this.stance = new Uint8Array(bytesOf(clip.stance));
    this.flatPath = new Float32Array(bytesOf(clip.flatPath));
    this.rows = new WeakMap(); // by the gaps of a motion
    this.paths = new WeakMap();
    for (const skeleton of skeletons) skeleton.measuring = this;
    this.captured = skeletons.find((skeleton) => skeleton.key === "captured") ?? null;
  }

  stands(frame, leg) {
    return this.stance[this.clip.legs.length * frame + leg] > 0;
  }

  // Distance of a leg's joint from the captured one in a frame, m.
  distance(skeleton, frame, leg, role) {
    const { captured } = this, own = 3 * skeleton.legs[leg][role], other = 3 * captured.legs[leg][role];
    return Math.hypot(...[0, 1, 2].map((axis) => skeleton.at(frame, own + axis) - captured.at(frame, other + axis)));
  }

  pelvisDifference(skeleton, frame) {
    return skeleton.at(frame, 3 * skeleton.pelvis + 1) - this.captured.at(frame, 3 * this.captured.pelvis + 1);
  }

  // How far a standing ball has gone since its stance began, beyond the animated one, m; 0 in a swing.
  slides(skeleton) {
    if (!this.paths.has(skeleton.gap)) this.paths.set(skeleton.gap, this.measureSlides(skeleton));
    return this.paths.get(skeleton.gap);
  }

  measureSlides(skeleton) {
    const { frames, legs } = this.clip, slides = new Float32Array(frames * legs.length);
    legs.forEach((_, leg) => {
      const ball = 3 * skeleton.legs[leg][3];
      for (const [first, last] of stretches((frame) => this.stands(frame, leg), frames)) {
        let path = 0;
        for (let frame = first + 1; frame <= last; frame++) {
          const step = (axis) => skeleton.at(frame, ball + axis) - skeleton.at(frame - 1, ball + axis);
          path += Math.hypot(step(0), step(2));
          const own = this.flatPath[legs.length * frame + leg] - this.flatPath[legs.length * first + leg];
          slides[legs.length * frame + leg] = path - own;
        }
      }
    });
    return slides;
  }

  // The cells of a motion, in the order of COLUMNS; NaN where there is nothing to compare with.
  row(skeleton) {
    if (!this.rows.has(skeleton.gap)) this.rows.set(skeleton.gap, this.measure(skeleton));
    return this.rows.get(skeleton.gap);
  }

  measure(skeleton) {
    const { frames, legs } = this.clip, ankles = [], standing = [], knees = [], pelvis = [], ends = [];
    const slides = this.slides(skeleton);
    let sunk = 0, known = 0;
    for (let frame = 0; frame < frames; frame++) {
      const gaps = legs.map((_, leg) => skeleton.gap[legs.length * frame + leg]);
      known += gaps.some((gap) => !Number.isNaN(gap));
      sunk += legs.some((_, leg) => skeleton.isSunk(frame, leg));
      if (!this.captured || skeleton === this.captured) continue;
      pelvis.push(this.pelvisDifference(skeleton, frame));
      legs.forEach((_, leg) => {
        ankles.push(this.distance(skeleton, frame, leg, 2));
        knees.push(this.distance(skeleton, frame, leg, 1));
        if (this.stands(frame, leg)) standing.push(ankles.at(-1));
      });
    }
    legs.forEach((_, leg) => {
      for (const [first, last] of stretches((frame) => this.stands(frame, leg), frames)) {
        if (last > first) ends.push(slides[legs.length * last + leg]);
      }
    });
    const cm = (values) => (values.length ? 100 * rms(values) : NaN);
    return [cm(ankles), cm(standing), cm(knees), cm(pelvis), (100 * sunk) / known, ends.length ? 100 * median(ends) : NaN];
  }

  // Where a motion is worst, by what: a sentence and a frame each, those that matter first.
  moments(skeleton) {
    const { frames, legs, rate } = this.clip, slides = this.slides(skeleton), moments = [];
    const worst = (words, least, value) => {
      let best = least, place = null;
      for (let frame = 0; frame < frames; frame++) {
        legs.forEach((_, leg) => {
          const here = value(frame, leg);
          if (here > best) [best, place] = [here, [frame, leg]];
        });
      }
      if (!place) return;
      const [frame, leg] = place;
      moments.push({ frame, words: `${words} ${(100 * best).toFixed(1)} cm, ${legs[leg]}, ${(frame / rate).toFixed(2)} s` });
    };
    const least = 0.5 * this.clip.visibleDepth;
    worst("Sole in the ground", least, (frame, leg) => -skeleton.gap[legs.length * frame + leg]);
    worst("Standing sole over the ground", least, (frame, leg) => (this.stands(frame, leg) ? skeleton.gap[legs.length * frame + leg] : 0));
    worst("Standing foot slides", least, (frame, leg) => slides[legs.length * frame + leg]);
    if (this.captured && skeleton !== this.captured) {
      worst("Ankle off the captured", 0.002, (frame, leg) => this.distance(skeleton, frame, leg, 2));
      worst("Knee off the captured", 0.002, (frame, leg) => this.distance(skeleton, frame, leg, 1));
    }
    return moments;
  }
}

// The table of all motions beside the view, and the buttons that lead to the worst moments.
class FigureTable {
  constructor(player) {
    this.player = player;
  }

  show() {
    const { measuring, watched } = this.player, { skeletons } = measuring;
    const rows = skeletons.map((skeleton) => [skeleton, measuring.row(skeleton)]);
    const used = COLUMNS.map((_, column) => rows.some(([, cells]) => !Number.isNaN(cells[column])));
    const shown = (values) => values.filter((_, column) => used[column]);
    const head = shown(COLUMNS).map(([title, unit, , meaning]) =>
      make("th", { scope: "col", title: meaning }, title, make("small", {}, unit)));
    const body = rows.map(([skeleton, cells]) => make("tr", { className: skeleton === watched ? "watched" : "" },
      make("th", { scope: "row" }, swatch(skeleton), skeleton.solution ? `${skeleton.label}, live` : skeleton.label),
      ...shown(cells.map((cell, column) => make("td", {}, Number.isNaN(cell) ? "–" : rounded(cell, COLUMNS[column][2])))),
    ));
    element("figures").replaceChildren(
      make("thead", {}, make("tr", {}, make("th", { scope: "col" }, "Motion"), ...head)), make("tbody", {}, ...body));
    element("moments").replaceChildren(...measuring.moments(watched).map(({ frame, words }) => {
      const button = make("button", { type: "button" }, words);
      button.addEventListener("click", () => this.player.jump(frame));
      return make("li", {}, button);
    }));
  }
}
