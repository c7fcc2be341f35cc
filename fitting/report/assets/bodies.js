// The body around a posed skeleton, as instances of limbs and slabs; its shape is of fitting/report/bodies.py.

const FIELDS = 18; // start, end, colour with opacity, radii at start, middle and end, across, depth, share of red
const SOLE = 0.016; // m, thickness, for an adult
const DARKER = 0.72; // of the colour, of a sole

class Instances {
  constructor() {
    this.limbs = [];
    this.slabs = [];
  }

  // A limb between two points; `across` points to one side of a flattened one.
  limb(start, end, colour, opacity, radii, across = [0, 0, 0], depth = 1, red = 0) {
    this.limbs.push(...start, ...end, ...colour, opacity, ...radii, ...across, depth, red);
  }

  // A flat piece with round ends, `above` its line; `widths` are half those of its ends.
  slab(start, end, colour, opacity, widths, across, thickness, red) {
    const middle = 0.5 * (widths[0] + widths[1]);
    this.slabs.push(...start, ...end, ...colour, opacity, widths[0], middle, widths[1], ...across, thickness, red);
  }

  // Extra capsules: start, end, colour, opacity and radius in a row.
  addSegments(segments) {
    for (let i = 0; i + 10 < segments.length; i += 11) {
      const [start, end, colour] = [0, 3, 6].map((at) => segments.subarray(i + at, i + at + 3));
      const radius = segments[i + 10];
      this.limb(start, end, colour, segments[i + 9], [radius, radius, radius]);
    }
  }
}

// All of a skeleton's body in its pose.
function figure(skeleton, time, palette, size) {
  const { shape, thickness, opacity } = skeleton, instances = new Instances();
  const colour = palette[skeleton.key];
  const places = shape.between.reduce((places, [a, b, share]) => {
    places.push(mix(places[a], places[b], share));
    return places;
  }, Array.from({ length: skeleton.points }, (_, i) => skeleton.point(i)));
  for (const [a, b, first, middle, last, depth, right, left] of shape.limbs) {
    const across = right < 0 ? undefined : subtract(places[left], places[right]);
    // The middle of a quadratic curve lies half-way between its ends and its control point.
    const radii = [first, 2 * middle - 0.5 * (first + last), last].map((radius) => thickness * radius);
    instances.limb(places[a], places[b], colour, opacity, radii, across, depth);
  }
  skeleton.soles.forEach((sole, leg) => {
    const red = skeleton.footShare(leg, time);
    const paint = skeleton.footColour(leg, time, palette);
    const glass = opacity + red * (1 - opacity);
    const ankle = places[skeleton.legs[leg][2]], [heel, ball] = sole.map((point) => places[point]);
    addFoot(instances, { ankle, heel, ball, plan: shape.feet[leg] },
      { colour: paint, opacity: glass, thickness: thickness + 0.1 * red, size, red });
  });
  return instances;
}

// A sole from heel to ball, toes that bend where the heel has risen, and what is between ankle and sole.
function addFoot(instances, { ankle, heel, ball, plan }, { colour, opacity, thickness, size, red }) {
  const radius = thickness * size;
  const along = subtract(ball, heel);
  if (!plan.length || Math.hypot(...along) < 1e-4) {
    instances.limb(ankle, heel, colour, opacity, [0.034, 0.03, 0.034].map((r) => r * radius), undefined, 1, red);
    return;
  }
  const [heelWidth, ballWidth, behind, ahead] = plan;
  const [wide, wider] = [heelWidth, ballWidth].map((width) => thickness * width), narrow = 0.62 * wider;
  const forward = normalise(along);
  const above = subtract(ankle, heel);
  const height = subtract(above, scale(forward, dot(above, forward)));
  const up = normalise(Math.hypot(...height) > 1e-4 ? height : [0, 1, 0]);
  const across = cross(forward, up);
  const level = [forward[0], Math.max(forward[1], 0), forward[2]]; // toes lie flat while the heel rises
  const bent = Math.hypot(...level) > 0.1 ? normalise(level) : forward;
  const back = subtract(heel, scale(forward, Math.max(behind - heelWidth, 0)));
  const tip = add(ball, scale(bent, Math.max(ahead - narrow, 0.2 * ahead)));
  const dark = colour.map((part) => DARKER * part), sole = SOLE * radius;
  instances.slab(back, ball, dark, opacity, [wide, wider], across, sole, red);
  instances.slab(ball, tip, dark, opacity, [wider, narrow], cross(bent, up), sole, red);
  const raised = (point, by) => add(point, scale(up, sole + by));
  const heelTop = raised(back, 0.6 * heelWidth), ballTop = raised(mix(ball, tip, 0.15), 0.35 * ballWidth);
  const tipTop = raised(tip, 0.1 * ballWidth), top = 0.036 * radius;
  const part = (start, end, radii, depth) => instances.limb(start, end, colour, opacity, radii, across, depth, red);
  part(ankle, heelTop, [top, top, 0.9 * top], 1);
  part(ankle, ballTop, [top, 0.85 * wider, 0.92 * wider], 0.52);
  part(heelTop, ballTop, [0.85 * wide, 0.9 * wide, 0.8 * wider], 0.8);
  part(ballTop, tipTop, [0.92 * wider, 0.85 * wider, 0.6 * wider], 0.45);
}
