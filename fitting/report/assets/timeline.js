// What happens when, over the slider: stances, feet in the ground, and the worst seconds.

const ROW = 9; // px, height of a leg's row
const INSET = 8; // px, half the slider's thumb
const SVG = "http://www.w3.org/2000/svg";

class Timeline {
  constructor(svg) {
    this.svg = svg;
  }

  // First and last frames of stretches in which a frame is marked.
  static stretches(isMarked, frames) {
    const stretches = [];
    for (let frame = 0; frame < frames; frame++) {
      if (!isMarked(frame)) continue;
      const last = stretches.at(-1);
      if (last && last[1] === frame - 1) last[1] = frame;
      else stretches.push([frame, frame]);
    }
    return stretches;
  }

  element(name, attributes, text = "") {
    const element = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    element.textContent = text;
    this.svg.append(element);
    return element;
  }

  setClip(clip, watched) {
    this.clip = clip;
    this.watched = watched;
    this.stance = new Uint8Array(bytesOf(clip.stance));
    this.drawAll();
  }

  x(frame) {
    const width = this.svg.clientWidth - 2 * INSET;
    return INSET + (width * Math.min(Math.max(frame, 0), this.clip.frames - 1)) / Math.max(this.clip.frames - 1, 1);
  }

  drawAll() {
    const { clip } = this;
    const legs = clip.legs.length;
    const height = 12 + ROW * legs;
    this.svg.replaceChildren();
    this.svg.style.height = `${height}px`;
    const bar = (stretch, leg, kind, thickness) => {
      const x = this.x(stretch[0] - 0.5);
      const width = Math.max(this.x(stretch[1] + 0.5) - x, 1.5);
      const y = 10 + ROW * leg + (ROW - 1 - thickness) / 2;
      this.element("rect", { class: kind, x, y, width, height: thickness, rx: 1.5 });
    };
    clip.legs.forEach((name, leg) => {
      for (const stretch of Timeline.stretches((frame) => this.stance[legs * frame + leg], clip.frames)) bar(stretch, leg, "stance", 7);
      for (const stretch of Timeline.stretches((frame) => this.watched.isSunk(frame, leg), clip.frames)) bar(stretch, leg, "sunk", 5);
    });
    const [start, end] = [this.x(this.watched.worst.start), this.x(this.watched.worst.end)];
    this.element("path", { class: "worst", d: `M${start} 9V4H${end}V9` });
    this.now = this.element("line", { class: "now", y1: 2, y2: height });
    this.point(0);
  }

  point(frame) {
    const x = this.x(frame);
    this.now.setAttribute("x1", x);
    this.now.setAttribute("x2", x);
  }
}
