// A camera that turns around a target, and the gestures that turn it.

const FIELD_OF_VIEW = 0.6; // rad
const VIEWS = { // heading from the direction of travel, elevation, rad; distance, body heights
  corner: [0.75, 0.26, 2.3],
  side: [Math.PI / 2, 0.08, 2.3],
  front: [0, 0.1, 2.3],
  top: [Math.PI / 2, 1.5, 3],
  feet: [1.1, 0.14, 1.1],
};

class Camera {
  constructor(canvas, changed) {
    this.canvas = canvas;
    this.changed = changed;
    this.pointers = new Map();
    this.target = [0, 0, 0];
    this.lowered = 0; // m, below the pelvis
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, (event) => this.pointers.delete(event.pointerId));
    }
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
  }

  // `low` and `high`: how far the body reaches below and above its pelvis, m.
  setClip(clip, low, high) {
    this.size = clip.size;
    this.height = low + high;
    this.middle = (low - high) / 2;
    this.feet = low - 0.18 * clip.size;
    this.travel = Math.atan2(clip.forward[0], clip.forward[1]);
    this.show("corner");
  }

  show(name) {
    const [heading, elevation, distance] = VIEWS[name];
    this.heading = this.travel + heading;
    this.elevation = elevation;
    this.distance = distance * (name === "feet" ? 1.7 * this.size : this.height + 0.3 * this.size);
    this.lowered = name === "feet" ? this.feet : this.middle;
    this.changed();
  }

  turn(heading, elevation) {
    this.heading += heading;
    this.elevation = Math.min(Math.max(this.elevation + elevation, -0.3), 1.55);
    this.changed();
  }

  zoom(factor) {
    this.distance = Math.min(Math.max(this.distance * factor, 0.5 * this.size), 60 * this.size);
    this.changed();
  }

  follow(pelvis) {
    this.target = [pelvis[0], pelvis[1] - this.lowered, pelvis[2]];
  }

  matrix(aspect) {
    const level = Math.cos(this.elevation);
    const back = [Math.sin(this.heading) * level, Math.sin(this.elevation), Math.cos(this.heading) * level];
    const distance = this.distance * Math.max(1, 1.25 / aspect);
    this.eye = add(this.target, scale(back, distance));
    const up = this.elevation > 1.4 ? [-Math.sin(this.heading), 0, -Math.cos(this.heading)] : [0, 1, 0];
    const lens = perspective(FIELD_OF_VIEW, aspect, 0.02 * distance, 40 * distance);
    return multiply(lens, lookAt(this.eye, this.target, up));
  }

  press(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
  }

  move(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const spread = () => {
      const [a, b] = [...this.pointers.values()];
      return Math.hypot(a[0] - b[0], a[1] - b[1]);
    };
    const apart = this.pointers.size === 2 ? spread() : 0;
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    if (apart) this.zoom(apart / Math.max(spread(), 1));
    else this.turn(-0.008 * (event.clientX - before[0]), 0.008 * (event.clientY - before[1]));
  }

  wheel(event) {
    if (document.activeElement !== this.canvas) return; // the page scrolls
    event.preventDefault();
    this.zoom(Math.exp(0.0012 * event.deltaY));
  }

  // Whether the key was one of the camera's.
  key(name) {
    const steps = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.08], ArrowDown: [0, -0.08] };
    if (steps[name]) this.turn(...steps[name]);
    else if (name === "+" || name === "=") this.zoom(1 / 1.15);
    else if (name === "-") this.zoom(1.15);
    else return false;
    return true;
  }
}
