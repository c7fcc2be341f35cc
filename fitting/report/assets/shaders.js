// Ground with a grid of metres and soft shadows of the body, and limbs and slabs that make the body.

const LIGHT = normalise([0.45, 1.0, 0.25]);

const GROUND_VERTICES = `#version 300 es
in vec3 position;
in vec3 normal;
in float margin; // 0 at the edge of what is known, 1 inside
uniform mat4 view;
out vec3 place;
out vec3 slope;
out float inside;
void main() {
  place = position;
  inside = margin;
  slope = normal;
  gl_Position = view * vec4(position, 1.0);
}`;

const GROUND_COLOURS = `#version 300 es
precision highp float;
in vec3 place;
in vec3 slope;
in float inside;
uniform vec3 low, high, grid, sky, light, target;
uniform vec2 heights;
uniform float reach, size;
uniform int shadows; // limbs that throw one: start with radius, and end, in a row each
uniform highp sampler2D limbs;
uniform vec3 middle; // x and z of the body, and how far from there they and their shadows reach
out vec4 colour;

float lines(vec2 at, float spacing) {
  vec2 cells = at / spacing;
  vec2 width = fwidth(cells);
  vec2 distance = abs(fract(cells - 0.5) - 0.5) / max(width, 1e-5);
  vec2 sharp = (1.0 - min(distance, 1.0)) * clamp(1.0 - 4.0 * width, 0.0, 1.0);
  return max(sharp.x, sharp.y);
}

void main() {
  float up = (place.y - heights.x) / max(heights.y - heights.x, 0.02);
  vec3 base = mix(low, high, clamp(up, 0.0, 1.0));
  float shade = 0.55 + 0.5 * max(dot(normalize(slope), light), 0.0);
  base *= shade;
  base = mix(base, grid, 0.45 * lines(place.xz, 1.0) + 0.12 * lines(place.xz, 0.25));
  float shadow = 0.0;
  int count = distance(place.xz, middle.xy) < middle.z ? shadows : 0;
  for (int i = 0; i < count; i++) {
    vec4 limb = texelFetch(limbs, ivec2(0, i), 0);
    vec3 start = limb.xyz;
    vec3 along = texelFetch(limbs, ivec2(1, i), 0).xyz - start;
    vec2 offset = place.xz - start.xz;
    float part = clamp(dot(offset, along.xz) / max(dot(along.xz, along.xz), 1e-6), 0.0, 1.0);
    float above = max(start.y + part * along.y - place.y, 0.0) / size;
    float radius = limb.w + size * (0.015 + 0.09 * above);
    float near = length(offset - part * along.xz) / radius;
    shadow = max(shadow, (1.0 - smoothstep(0.3, 1.0, near)) / (1.0 + 3.0 * above));
  }
  base *= 1.0 - 0.6 * shadow;
  float far = smoothstep(0.55 * reach, reach, distance(place, target));
  colour = vec4(mix(base, sky, far), 1.0) * smoothstep(0.0, 1.0, inside);
}`;

// A limb or a slab from start to end. Limbs are round or flattened, with radii along a quadratic curve;
// slabs lie above their line.
const BODY_VERTICES = `#version 300 es
in vec4 corner; // direction from the end: across, along, deep; and which part of the way
in vec3 facing; // likewise
in vec3 start, end;
in vec4 tint;
in vec3 radii; // at the start, of the curve's control point, at the end
in vec3 across;
in vec2 more; // depth of the radius, or m of a slab; share of red
uniform mat4 view;
uniform bool isSlab;
out vec3 outward;
out vec3 place;
out vec4 paint;
out float red;
void main() {
  vec3 along = end - start;
  float span = length(along);
  vec3 axis = span > 1e-6 ? along / span : vec3(0.0, 1.0, 0.0);
  vec3 other = abs(axis.y) < 0.9 ? vec3(0.0, 1.0, 0.0) : vec3(1.0, 0.0, 0.0);
  vec3 side = across - axis * dot(across, axis);
  side = length(side) > 1e-4 * length(across) && length(across) > 0.0 ? side : cross(axis, other);
  side = normalize(side);
  vec3 deep = cross(side, axis);
  float t = corner.w;
  float radius = mix(mix(radii.x, radii.y, t), mix(radii.y, radii.z, t), t);
  float slope = 2.0 * mix(radii.y - radii.x, radii.z - radii.y, t) / max(span, radius);
  float depth = isSlab ? 1.0 : more.x;
  vec3 offset = radius * (side * corner.x + axis * corner.y * min(depth, 1.0));
  offset += deep * corner.z * (isSlab ? more.x : radius * depth);
  float level = 1.0 - abs(facing.y); // 0 at the poles
  outward = side * facing.x + axis * (facing.y / min(depth, 1.0) - slope * level) + deep * facing.z / depth;
  place = mix(start, end, t) + offset;
  paint = tint;
  red = more.y;
  gl_Position = view * vec4(place, 1.0);
}`;

// The mesh of a character: each vertex follows four slots, whose matrices are rows of a texture.
const SKIN_VERTICES = `#version 300 es
in vec3 position, normal;
in vec4 followed, weights;
uniform mat4 view;
uniform highp sampler2D slots;
uniform vec4 tint;
uniform float swelling; // m, along the normal
out vec3 outward;
out vec3 place;
out vec4 paint;
out float red;
void main() {
  place = outward = vec3(0.0);
  red = 0.0;
  for (int i = 0; i < 4; i++) {
    int slot = int(followed[i]);
    vec4 x = texelFetch(slots, ivec2(0, slot), 0), y = texelFetch(slots, ivec2(1, slot), 0);
    vec4 z = texelFetch(slots, ivec2(2, slot), 0);
    vec4 at = vec4(position, 1.0);
    place += weights[i] * vec3(dot(x, at), dot(y, at), dot(z, at));
    outward += weights[i] * vec3(dot(x.xyz, normal), dot(y.xyz, normal), dot(z.xyz, normal));
    red += weights[i] * texelFetch(slots, ivec2(3, slot), 0).x;
  }
  outward = length(outward) > 0.0 ? normalize(outward) : vec3(0.0, 1.0, 0.0);
  place += swelling * outward;
  paint = tint;
  gl_Position = view * vec4(place, 1.0);
}`;

const BODY_COLOURS = `#version 300 es
precision highp float;
in vec3 outward;
in vec3 place;
in vec4 paint; // the less opaque, the more only its rim is seen, like glass
in float red;
uniform vec3 light, eye, sunk;
uniform float strength; // below 1 of what is hidden, where red is seen better
uniform bool isSkin; // whose feet are coloured here
out vec4 colour;
void main() {
  vec3 base = isSkin ? mix(paint.rgb, sunk, red) : paint.rgb;
  float solid = isSkin ? mix(paint.a, 1.0, red) : paint.a;
  vec3 normal = normalize(outward);
  vec3 toEye = normalize(eye - place);
  float facing = abs(dot(normal, toEye));
  float lit = 0.5 + 0.5 * dot(normal, light);
  float shade = 0.5 + 0.58 * lit * lit + 0.1 * facing;
  float shine = 0.12 * pow(max(dot(reflect(-light, normal), toEye), 0.0), 16.0);
  float opacity = mix(0.06 + 0.94 * pow(1.0 - facing, 1.5), 1.0, solid);
  colour = vec4(min(base * shade + shine, 1.0), 1.0) * opacity * mix(strength, 1.0, 0.45 * red);
}`;

// A capsule: rings of directions around both ends, and rings between. Corners are of 7 numbers.
function capsule() {
  const SIDES = 14, CAP = 4, SHAFT = 6;
  const vertices = [], triangles = [];
  const ring = (latitude, part) => {
    for (let side = 0; side <= SIDES; side++) {
      const angle = (2 * Math.PI * side) / SIDES, level = Math.cos(latitude);
      const direction = [level * Math.cos(angle), Math.sin(latitude), level * Math.sin(angle)];
      vertices.push(...direction, part, ...direction);
    }
  };
  for (let i = 0; i < CAP; i++) ring((Math.PI / 2) * (i / CAP - 1), 0);
  for (let i = 0; i <= SHAFT; i++) ring(0, i / SHAFT);
  for (let i = 1; i <= CAP; i++) ring((Math.PI / 2) * (i / CAP), 1);
  const stride = SIDES + 1;
  for (let row = 0; row < 2 * CAP + SHAFT; row++) {
    for (let side = 0; side < SIDES; side++) {
      const a = row * stride + side;
      triangles.push(a, a + stride, a + 1, a + 1, a + stride, a + stride + 1);
    }
  }
  return { vertices: new Float32Array(vertices), triangles: new Uint16Array(triangles) };
}

// A flat piece with round ends: its bottom, its top, and its edge.
function slab() {
  const ARC = 8;
  const vertices = [], triangles = [];
  for (const [first, last, end] of [[0, ARC, 1], [ARC, 2 * ARC, 0], [0, 0, 1]]) { // the last one closes it
    for (let i = first; i <= last; i++) {
      const [x, y] = [Math.cos((Math.PI * i) / ARC), Math.sin((Math.PI * i) / ARC)];
      for (const [z, ...facing] of [[0, 0, 0, -1], [1, 0, 0, 1], [0, x, y, 0], [1, x, y, 0]]) {
        vertices.push(x, y, z, end, ...facing);
      }
    }
  }
  for (let side = 0; side < 2 * ARC + 2; side++) {
    const a = 4 * side, b = a + 4;
    triangles.push(a + 2, b + 2, a + 3, a + 3, b + 2, b + 3);
    if (side > 0) triangles.push(0, b, a, 1, a + 1, b + 1);
  }
  return { vertices: new Float32Array(vertices), triangles: new Uint16Array(triangles) };
}
