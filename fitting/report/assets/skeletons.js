// Unpacks what fitting/report/motion_data.py has packed.

const FADE = 0.3; // m inside its edge, for an adult, over which the ground appears
const NO_GAP = -32768;

function bytesOf(base64) {
  return Uint8Array.from(atob(base64), (character) => character.charCodeAt(0)).buffer;
}

const skins = new Map(); // by the key of the skeleton that brings one

class Skeleton {
  // `visibleDepth`: m, from which on a sole is marked as in the ground.
  constructor(packed, legs, visibleDepth) {
    Object.assign(this, packed, { visibleDepth });
    this.root = new Float32Array(bytesOf(packed.root));
    this.offsets = new Int16Array(bytesOf(packed.offsets));
    this.packedGap = Float32Array.from(new Int16Array(bytesOf(packed.gap)), (step) => (step === NO_GAP ? NaN : 1e-4 * step));
    this.show(null);
    if (packed.skin) skins.set(packed.skinned, new Skin(packed.skin));
    this.skin = skins.get(packed.skinned) ?? null;
    if (this.skin) this.turns = new Int16Array(bytesOf(packed.turns));
    this.legCount = legs;
    this.positions = new Float32Array(3 * packed.points);
  }

  // Another motion of this skeleton, `points` in each frame and the `gap` below each sole; null is its own.
  // With a skin it may have `turns` as the skeleton has them.
  show(solution) {
    this.solution = solution;
    this.gap = solution ? solution.gap : this.packedGap;
  }

  // A coordinate of a point in a frame, m; `i` is the point's number times 3, plus that of the axis.
  at(frame, i) {
    if (this.solution) return this.solution.points[3 * this.points * frame + i];
    return this.packed(frame, i);
  }

  packed(frame, i) {
    return this.root[3 * frame + (i % 3)] + this.quantum * this.offsets[3 * this.points * frame + i];
  }

  // A point of its own motion, whatever is shown, in the frame before a time.
  packedPoint(index, time) {
    const frame = Math.min(Math.floor(time), this.root.length / 3 - 1);
    return [0, 1, 2].map((axis) => this.packed(frame, 3 * index + axis));
  }

  // All points at a time in frames, linear between two, in `positions`; m.
  pose(time) {
    const last = this.root.length / 3 - 1;
    const first = Math.min(Math.floor(time), last);
    const second = Math.min(first + 1, last);
    const part = time - first;
    const count = 3 * this.points;
    for (let i = 0; i < count; i++) {
      const a = this.at(first, i);
      this.positions[i] = a + part * (this.at(second, i) - a);
    }
    return this.positions;
  }

  point(index) {
    return [...this.positions.subarray(3 * index, 3 * index + 3)];
  }

  // How far the shown pose reaches below and above its pelvis, m.
  reach() {
    const heights = Array.from({ length: this.points }, (_, i) => this.positions[3 * i + 1]);
    const pelvis = heights[this.pelvis];
    return [pelvis - Math.min(...heights), Math.max(...heights) - pelvis];
  }

  // Which feet are in the ground in the frame that is shown.
  sunkLegs(time) {
    const frame = this.frame(time);
    return Array.from({ length: this.legCount }, (_, leg) => this.isSunk(frame, leg));
  }

  isSunk(frame, leg) {
    return this.gap[this.legCount * frame + leg] < -this.visibleDepth;
  }

  // How far a foot has the colour of what is wrong: 1 where it is marked, 0 at half that depth.
  footShare(leg, time) {
    const depth = -this.gap[this.legCount * this.frame(time) + leg] / this.visibleDepth;
    return Math.min(Math.max(2 * depth - 1, 0), 1) || 0; // without ground there is no depth
  }

  // The redder the deeper it is, the more purple the further it has slid in its stance.
  footColour(leg, time, palette) {
    const slid = this.measuring.slides(this)[this.legCount * this.frame(time) + leg] / this.visibleDepth;
    const colour = mix(palette[this.key], palette.sliding, Math.min(Math.max(slid, 0), 1));
    return mix(colour, palette.sunk, this.footShare(leg, time));
  }

  frame(time) {
    return Math.min(Math.round(time), this.root.length / 3 - 1);
  }
}

class Ground {
  constructor(packed, size) {
    Object.assign(this, packed);
    const steps = new Uint16Array(bytesOf(packed.heights));
    const { rows, columns, spacing } = packed;
    const HOLE = 65535;
    this.size = size;
    this.positions = new Float32Array(3 * rows * columns);
    this.normals = new Float32Array(3 * rows * columns);
    const height = (row, column) => {
      const inside = row >= 0 && row < rows && column >= 0 && column < columns;
      const step = inside ? steps[row * columns + column] : HOLE;
      return step === HOLE ? NaN : packed.low + packed.quantum * step;
    };
    const slope = (before, here, after) => {
      const known = !Number.isNaN(before) + !Number.isNaN(after);
      if (!known) return 0;
      const first = Number.isNaN(before) ? here : before;
      const last = Number.isNaN(after) ? here : after;
      return (last - first) / (known * spacing);
    };
    this.margins = new Float32Array(rows * columns);
    const triangles = [];
    this.lowest = Infinity;
    this.highest = -Infinity;
    for (let row = 0; row < rows; row++) {
      for (let column = 0; column < columns; column++) {
        const i = 3 * (row * columns + column);
        const here = height(row, column);
        this.positions.set([column * spacing, here, row * spacing], i);
        const along = slope(height(row, column - 1), here, height(row, column + 1));
        const across = slope(height(row - 1, column), here, height(row + 1, column));
        this.normals.set(normalise([-along, 1, -across]), i);
        this.margins[i / 3] = Number.isNaN(here) ? 0 : Infinity;
        if (here < this.lowest) this.lowest = here;
        if (here > this.highest) this.highest = here;
        const corners = [i / 3, i / 3 + 1, i / 3 + columns, i / 3 + columns + 1];
        const known = [here, height(row, column + 1), height(row + 1, column), height(row + 1, column + 1)];
        if (!known.some(Number.isNaN)) {
          triangles.push(corners[0], corners[2], corners[1], corners[1], corners[2], corners[3]);
        }
      }
    }
    this.triangles = new Uint32Array(triangles);
    this.measureMargins(rows, columns);
  }

  // Distance from the edge of what is known, as a fraction of the band in which the ground fades.
  measureMargins(rows, columns) {
    const step = this.spacing / (FADE * this.size);
    const margins = this.margins;
    const at = (row, column) =>
      row >= 0 && row < rows && column >= 0 && column < columns ? margins[row * columns + column] : 0;
    const relax = (row, column, d) => {
      const nearest = Math.min(
        at(row, column + d) + step, at(row + d, column) + step,
        at(row + d, column + d) + 1.414 * step, at(row + d, column - d) + 1.414 * step,
      );
      const i = row * columns + column;
      margins[i] = Math.min(margins[i], nearest);
    };
    for (let row = 0; row < rows; row++) {
      for (let column = 0; column < columns; column++) relax(row, column, -1);
    }
    for (let row = rows - 1; row >= 0; row--) {
      for (let column = columns - 1; column >= 0; column--) relax(row, column, 1);
    }
  }
}
