// Ground with a grid of metres and soft shadows of the bones, and bones as capsules.

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
uniform int shadows; // bones that throw one: start and end in a row each
uniform highp sampler2D bones;
uniform vec3 middle; // x and z of the bones, and how far from there they and their shadows reach
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
    vec3 start = texelFetch(bones, ivec2(0, i), 0).xyz;
    vec3 along = texelFetch(bones, ivec2(1, i), 0).xyz - start;
    vec2 offset = place.xz - start.xz;
    float part = clamp(dot(offset, along.xz) / max(dot(along.xz, along.xz), 1e-6), 0.0, 1.0);
    float above = max(start.y + part * along.y - place.y, 0.0) / size;
    float radius = size * (0.035 + 0.09 * above);
    float near = length(offset - part * along.xz) / radius;
    shadow = max(shadow, (1.0 - smoothstep(0.3, 1.0, near)) / (1.0 + 3.0 * above));
  }
  base *= 1.0 - 0.6 * shadow;
  float far = smoothstep(0.55 * reach, reach, distance(place, target));
  colour = vec4(mix(base, sky, far), 1.0) * smoothstep(0.0, 1.0, inside);
}`;

const BONE_VERTICES = `#version 300 es
in vec4 corner; // direction from the bone's end, and which end
in vec3 start, end;
in vec4 tint;
in float radius;
uniform mat4 view;
out vec3 outward;
out vec3 place;
out vec4 paint;
void main() {
  vec3 along = end - start;
  float span = length(along);
  vec3 axis = span > 1e-6 ? along / span : vec3(0.0, 1.0, 0.0);
  vec3 side = normalize(cross(axis, abs(axis.y) < 0.9 ? vec3(0.0, 1.0, 0.0) : vec3(1.0, 0.0, 0.0)));
  outward = side * corner.x + axis * corner.y + cross(side, axis) * corner.z;
  paint = tint;
  place = mix(start, end, corner.w) + radius * outward;
  gl_Position = view * vec4(place, 1.0);
}`;

const BONE_COLOURS = `#version 300 es
precision highp float;
in vec3 outward;
in vec3 place;
in vec4 paint; // the less opaque, the more only its rim is seen, like glass
uniform vec3 light, eye;
uniform float strength;
out vec4 colour;
void main() {
  vec3 normal = normalize(outward);
  float shade = 0.62 + 0.45 * max(dot(normal, light), 0.0);
  float rim = 1.0 - abs(dot(normal, normalize(eye - place)));
  float opacity = mix(0.06 + 0.94 * pow(rim, 1.5), 1.0, paint.a);
  colour = vec4(min(paint.rgb * shade, 1.0), 1.0) * opacity * strength;
}`;

// A capsule around a bone: rings of directions around both ends.
function capsule() {
  const SIDES = 12, RINGS = 4;
  const corners = [];
  for (const end of [0, 1]) {
    for (let ring = 0; ring <= RINGS; ring++) {
      const latitude = (Math.PI / 2) * (end ? ring / RINGS : ring / RINGS - 1);
      for (let side = 0; side <= SIDES; side++) {
        const angle = (2 * Math.PI * side) / SIDES;
        const across = Math.cos(latitude);
        corners.push(across * Math.cos(angle), Math.sin(latitude), across * Math.sin(angle), end);
      }
    }
  }
  const triangles = [];
  const stride = SIDES + 1;
  for (let ring = 0; ring < 2 * RINGS + 1; ring++) {
    for (let side = 0; side < SIDES; side++) {
      const a = ring * stride + side;
      triangles.push(a, a + stride, a + 1, a + 1, a + stride, a + stride + 1);
    }
  }
  return { corners: new Float32Array(corners), triangles: new Uint16Array(triangles) };
}
