// Curves below the time line: heights of soles, angles of knees, height of the pelvis.

const PANEL = 62; // px, height of one
const PANELS = [
  { title: "Soles over the ground", unit: "cm", digits: 1, zero: true },
  { title: "Knees", unit: "°", digits: 0 },
  { title: "Pelvis, from where it begins", unit: "cm", digits: 1 },
];

class Curves {
  constructor(svg) {
    this.svg = svg;
  }

  // Draws those of the watched motion, and of the captured one behind it.
  show(player) {
    this.player = player;
    const { clip, watched, measuring } = player;
    const captured = measuring.captured === watched ? null : measuring.captured;
    this.series = [];
    for (const [skeleton, kind] of [[captured, "captured"], [watched, "watched"]]) {
      if (skeleton) this.series.push({ kind, skeleton, values: PANELS.map((_, panel) => this.values(clip, skeleton, panel)) });
    }
    this.draw();
  }

  // One list of values over the frames for each line of a panel.
  values(clip, skeleton, panel) {
    const frames = Array.from({ length: clip.frames }, (_, frame) => frame), count = clip.legs.length;
    if (panel === 0) return clip.legs.map((_, leg) => frames.map((frame) => 100 * skeleton.gap[count * frame + leg]));
    if (panel === 1) return clip.legs.map((_, leg) => frames.map((frame) => this.kneeAngle(skeleton, frame, leg)));
    const height = (frame) => skeleton.at(frame, 3 * skeleton.pelvis + 1), origin = this.player.skeletons[0];
    return [frames.map((frame) => 100 * (height(frame) - origin.at(0, 3 * origin.pelvis + 1)))];
  }

  // Inside angle, degrees: 180 is straight.
  kneeAngle(skeleton, frame, leg) {
    const [hip, knee, ankle] = skeleton.legs[leg].map((joint) => [0, 1, 2].map((axis) => skeleton.at(frame, 3 * joint + axis)));
    const up = normalise(subtract(hip, knee)), down = normalise(subtract(ankle, knee));
    return (180 / Math.PI) * Math.acos(Math.min(Math.max(dot(up, down), -1), 1));
  }

  draw() {
    if (!this.series || !this.svg.clientWidth) return;
    const { timeline } = this.player;
    this.svg.replaceChildren();
    this.svg.style.height = `${PANEL * PANELS.length}px`;
    this.readouts = PANELS.map((panel, number) => {
      const top = PANEL * number, all = this.series.flatMap(({ values }) => values[number]).flat().filter(Number.isFinite);
      let low = all.reduce((a, b) => Math.min(a, b), panel.zero ? 0 : Infinity);
      let high = all.reduce((a, b) => Math.max(a, b), panel.zero ? 0 : -Infinity);
      if (!(high > low)) [low, high] = [low - 1, low + 1];
      const y = (value) => top + PANEL - 8 - ((PANEL - 26) * (value - low)) / (high - low);
      if (panel.zero) addSvg(this.svg, "line", { class: "zero", x1: timeline.x(0), x2: timeline.x(Infinity), y1: y(0), y2: y(0) });
      for (const { kind, values } of this.series) {
        values[number].forEach((line, leg) => addSvg(this.svg, "path", { class: `${kind} leg-${leg % 2}`, d: this.path(line, y) }));
      }
      return addSvg(this.svg, "text", { x: timeline.x(0), y: top + 11 });
    });
    this.now = addSvg(this.svg, "line", { class: "now", y1: 0, y2: PANEL * PANELS.length });
    this.point(this.player.time);
  }

  // No more points than there are pixels; a gap where there is no ground.
  path(line, y) {
    const { timeline } = this.player, step = Math.max(1, Math.floor(line.length / Math.max(this.svg.clientWidth, 1)));
    let path = "", isDown = false;
    for (let frame = 0; frame < line.length; frame += step) {
      const known = Number.isFinite(line[frame]);
      if (known) path += `${isDown ? "L" : "M"}${timeline.x(frame).toFixed(1)} ${y(line[frame]).toFixed(1)}`;
      isDown = known;
    }
    return path;
  }

  // Moves the cursor, and says the values there.
  point(time) {
    if (!this.now) return;
    const { timeline, clip } = this.player, frame = Math.min(Math.round(time), clip.frames - 1);
    for (const end of ["x1", "x2"]) this.now.setAttribute(end, timeline.x(time));
    const { values } = this.series.at(-1);
    PANELS.forEach(({ title, unit, digits }, number) => {
      const names = values[number].length > 1 ? clip.legs : [""];
      const texts = values[number].map((line, leg) => `${names[leg]} ${Number.isFinite(line[frame]) ? rounded(line[frame], digits) : "–"}`.trim());
      this.readouts[number].textContent = `${title}: ${texts.join(", ")} ${unit}`;
    });
  }
}
