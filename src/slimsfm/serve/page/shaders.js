/** The programs of the painter, in GLSL ES 3.0. */

/** Points of the world in the camera's frame, displaced as the lens does: like `project` in pose.js. */
const SEEN = `#version 300 es
precision highp float;
uniform mat4 view, projection;
uniform vec4 distortion;

vec3 seen(vec3 inWorld) {
  return (view * vec4(inWorld, 1.0)).xyz;
}

vec4 clipped(vec3 p) {
  if (p.z <= 0.0) return projection * vec4(p, 1.0);
  vec2 n = p.xy / p.z;
  float square = min(dot(n, n), 4.0);
  float radial = 1.0 + square * (distortion.x + square * distortion.y);
  vec2 bent = n * radial + 2.0 * n.x * n.y * distortion.zw + distortion.wz * (square + 2.0 * n * n);
  return projection * vec4(bent * p.z, p.z, 1.0);
}
`;

export const PICTURE = {
  vertex: `#version 300 es
in vec2 corner;
out vec2 place;
void main() {
  place = vec2(corner.x, 1.0 - corner.y);
  gl_Position = vec4(2.0 * corner - 1.0, 0.0, 1.0);
}`,
  fragment: `#version 300 es
precision mediump float;
uniform sampler2D image;
in vec2 place;
out vec4 color;
void main() {
  color = vec4(texture(image, place).rgb, 1.0);
}`,
};

/** Each line is a quad of constant width with soft edges; `corner` is (0 or 1 along, -1 or 1 across). */
export const LINES = {
  vertex: `${SEEN}
uniform vec2 size;
uniform float width, near;
uniform vec4 paint;
in vec2 corner;
in vec3 from, to, tint;
out vec4 shade;
out float away;

void main() {
  vec3 a = seen(from), b = seen(to);
  shade = vec4(mix(tint, paint.rgb, paint.a), 1.0);
  if (max(a.z, b.z) < near) {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
    return;
  }
  if (a.z < near) a = mix(b, a, (b.z - near) / (b.z - a.z));
  if (b.z < near) b = mix(a, b, (a.z - near) / (a.z - b.z));
  vec4 start = clipped(a), stop = clipped(b);
  vec2 way = (stop.xy / stop.w - start.xy / start.w) * size;
  vec2 along = length(way) > 0.001 ? normalize(way) : vec2(1.0, 0.0);
  vec2 aside = vec2(-along.y, along.x) * corner.y + along * (2.0 * corner.x - 1.0);
  gl_Position = corner.x < 0.5 ? start : stop;
  gl_Position.xy += aside * (width + 1.0) / size * gl_Position.w;
  away = 0.5 * (width + 1.0) * corner.y;
}`,
  fragment: `#version 300 es
precision mediump float;
uniform float opacity;
uniform highp float width;
in vec4 shade;
in float away;
out vec4 color;
void main() {
  float covered = opacity * clamp(0.5 * (width + 1.0) - abs(away), 0.0, 1.0);
  color = vec4(shade.rgb, 1.0) * covered;
}`,
};

export const POINTS = {
  vertex: `${SEEN}
uniform float width;
in vec3 from, tint;
out vec3 shade;
void main() {
  shade = tint;
  vec3 p = seen(from);
  gl_Position = p.z > 0.0 ? clipped(p) : vec4(2.0, 2.0, 2.0, 1.0);
  gl_PointSize = width;
}`,
  fragment: `#version 300 es
precision mediump float;
uniform float opacity, core;
uniform highp float width;
in vec3 shade;
out vec4 color;
void main() {
  float away = 2.0 * length(gl_PointCoord - 0.5);
  float covered = opacity * clamp(0.5 * width * (1.0 - away), 0.0, 1.0);
  color = vec4(away > core ? vec3(0.0) : shade, 1.0) * covered;
}`,
};

/** A matte surface, lit from above the camera and by ambient light; both sides alike. */
export const MESH = {
  vertex: `${SEEN}
in vec3 from, normal, tint;
in vec2 texel;
out vec3 facing, shade;
out vec2 place;
void main() {
  facing = mat3(view) * normal;
  shade = tint;
  place = texel;
  gl_Position = clipped(seen(from));
}`,
  fragment: `#version 300 es
precision mediump float;
uniform sampler2D image;
uniform bool textured;
in vec3 facing, shade;
in vec2 place;
out vec4 color;
const vec3 lamp = vec3(0.2, -0.55, -0.81);
void main() {
  float lit = 0.45 + 0.6 * abs(dot(normalize(facing), lamp));
  color = vec4((textured ? texture(image, place).rgb : vec3(1.0)) * shade * lit, 1.0);
}`,
};
