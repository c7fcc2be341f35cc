// What happens when, over the slider: stances, feet in the ground, and the worst seconds.

const ROW = 9; // px, height of a leg's row
const TALL_ROW = 22; // px, where stances can be changed
const INSET = 8; // px, half the slider's thumb
const SVG = "http://www.w3.org/2000/svg";

function addSvg(parent, name, attributes, text = "") {
  const child = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) child.setAttribute(key, value);
  child.textContent = text;
  parent.append(child);
  return child;
}

class Timeline {
  constructor(svg) {
    this.svg = svg;
  }

  // `contacts` draws the stances itself where they can be changed; else null.
  setClip(clip, watched, contacts) {
    Object.assign(this, { clip, watched, contacts });
    this.row = contacts ? TALL_ROW : ROW;
    this.svg.setAttribute("role", contacts ? "group" : "img"); // an image has no parts to operate
    this.stance = new Uint8Array(bytesOf(clip.stance));
    this.drawAll();
  }

  x(frame) {
    const width = this.svg.clientWidth - 2 * INSET;
    return INSET + (width * Math.min(Math.max(frame, 0), this.clip.frames - 1)) / Math.max(this.clip.frames - 1, 1);
  }

  // The time in frames at a place of the pointer.
  time(clientX) {
    const { left, width } = this.svg.getBoundingClientRect();
    const part = (clientX - left - INSET) / Math.max(width - 2 * INSET, 1);
    return Math.min(Math.max(part, 0), 1) * (this.clip.frames - 1);
  }

  top(leg) {
    return 10 + this.row * leg;
  }

  drawAll() {
    const { clip } = this, legs = clip.legs.length;
    const height = 12 + this.row * legs;
    this.svg.replaceChildren();
    this.svg.style.height = `${height}px`;
    const bar = (stretch, leg, kind, thickness) => {
      const x = this.x(stretch[0] - 0.5);
      const width = Math.max(this.x(stretch[1] + 0.5) - x, 1.5);
      const y = this.top(leg) + (this.row - 1 - thickness) / 2;
      addSvg(this.svg, "rect", { class: kind, x, y, width, height: thickness, rx: 1.5 });
    };
    clip.legs.forEach((name, leg) => {
      if (!this.contacts) {
        for (const stretch of stretches((frame) => this.stance[legs * frame + leg], clip.frames)) bar(stretch, leg, "stance", 7);
      }
      for (const stretch of stretches((frame) => this.watched.isSunk(frame, leg), clip.frames)) bar(stretch, leg, "sunk", 5);
    });
    this.contacts?.draw();
    if (this.watched.worst) {
      const [start, end] = [this.x(this.watched.worst.start), this.x(this.watched.worst.end)];
      addSvg(this.svg, "path", { class: "worst", d: `M${start} 9V4H${end}V9` });
    }
    this.now = addSvg(this.svg, "line", { class: "now", y1: 2, y2: height });
    this.point(0);
  }

  point(frame) {
    const x = this.x(frame);
    this.now.setAttribute("x1", x);
    this.now.setAttribute("x2", x);
  }
}
