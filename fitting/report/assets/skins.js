// Meshes of characters, which follow the joints of a skeleton; packed by fitting/report/bodies.py.

const SKIN_FIELDS = [["position", 3], ["normal", 3], ["followed", 4], ["weights", 4]];

const turn = (q, v) => {
  const axis = q.slice(1), aside = scale(cross(axis, v), 2);
  return add(add(v, scale(aside, q[0])), cross(axis, aside));
};

const product = (a, b) => [
  a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
  a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
  a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
  a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
];

const unit = (q) => q.map((part) => part / (Math.hypot(...q) || 1));

// The shortest turn from one direction to another.
function arc(from, to) {
  const [a, b] = [normalise(from), normalise(to)];
  return dot(a, b) < -0.9999 ? [1, 0, 0, 0] : unit([1 + dot(a, b), ...cross(a, b)]);
}

class Skin {
  constructor(packed) {
    Object.assign(this, packed);
    const places = new Uint16Array(bytesOf(packed.vertices));
    const positions = Float32Array.from(places, (place, i) => packed.low[i % 3] + packed.step[i % 3] * place);
    const count = positions.length / 3;
    const Whole = count <= 65535 ? Uint16Array : Uint32Array;
    this.triangles = new Whole(bytesOf(packed.triangles));
    this.binds = new Float32Array(bytesOf(packed.binds));
    const parts = [positions, this.normals(positions), new Uint16Array(bytesOf(packed.followed)),
      Float32Array.from(new Uint8Array(bytesOf(packed.weights)), (weight) => weight / 255)];
    const widths = SKIN_FIELDS.map(([, size]) => size), stride = widths.reduce((a, b) => a + b);
    this.vertices = new Float32Array(stride * count); // fields after one another, vertex by vertex
    for (let i = 0, at = 0; i < count; i++) {
      for (let k = 0; k < parts.length; k++) {
        for (let j = 0; j < widths[k]; j++) this.vertices[at++] = parts[k][widths[k] * i + j];
      }
    }
  }

  // Of each vertex, the mean of its triangles, the larger the more.
  normals(positions) {
    const normals = new Float32Array(positions.length);
    const at = (i) => positions.subarray(3 * i, 3 * i + 3);
    for (let i = 0; i < this.triangles.length; i += 3) {
      const corners = this.triangles.subarray(i, i + 3);
      const [a, b, c] = [...corners].map(at);
      const normal = cross(subtract(b, a), subtract(c, a));
      for (const corner of corners) for (let k = 0; k < 3; k++) normals[3 * corner + k] += normal[k];
    }
    return normals;
  }

  // Four texels for each slot: the rows of its matrix from the mesh to the page, and its share of red.
  texels(skeleton, time) {
    const rotations = this.rotations(skeleton, time), reds = this.reds(skeleton, time);
    const texels = new Float32Array(16 * this.slots.length);
    this.slots.forEach((which, slot) => {
      const place = skeleton.point(this.joints[which]), bind = this.binds.subarray(12 * slot, 12 * slot + 12);
      for (let column = 0; column < 4; column++) {
        const moved = turn(rotations[which], [bind[column], bind[4 + column], bind[8 + column]]);
        const at = column === 3 ? add(moved, place) : moved;
        for (let row = 0; row < 3; row++) texels[16 * slot + 4 * row + column] = at[row];
      }
      texels[16 * slot + 12] = reds[which];
    });
    return texels;
  }

  // Those of the frames around a time; of another motion without its own, turned as its bones are.
  rotations(skeleton, time) {
    const turns = skeleton.solution?.turns ?? skeleton.turns;
    const last = skeleton.root.length / 3 - 1, first = Math.min(Math.floor(time), last);
    const part = time - first, next = Math.min(first + 1, last), count = this.joints.length;
    const own = this.joints.map((_, i) => unit([0, 1, 2, 3].map((k) => {
      const a = turns[4 * (count * first + i) + k], b = turns[4 * (count * next + i) + k];
      return a + part * (b - a);
    })));
    if (!skeleton.solution || skeleton.solution.turns) return own;
    const changes = [];
    this.joints.forEach((joint, i) => {
      const towards = this.towards[i];
      if (towards < 0) return changes.push(changes[this.above[i]] ?? [1, 0, 0, 0]);
      const before = subtract(skeleton.packedPoint(towards, time), skeleton.packedPoint(joint, time));
      changes.push(arc(before, subtract(skeleton.point(towards), skeleton.point(joint))));
    });
    return own.map((rotation, i) => product(changes[i], rotation));
  }

  // Ankles of feet that are marked, and what hangs on them.
  reds(skeleton, time) {
    const reds = [];
    this.joints.forEach((joint, i) => {
      const leg = skeleton.legs.findIndex((joints) => joints[2] === joint);
      reds.push(leg < 0 ? reds[this.above[i]] ?? 0 : skeleton.footShare(leg, time));
    });
    return reds;
  }
}
