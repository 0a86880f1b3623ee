// GLSL. Objects are drawn as instances: a mesh per asset, a place, a rotation and a slot per object.

const HEADER = "#version 300 es\nprecision highp float;\nprecision highp int;\n";

const OBJECT_VERTEX = `${HEADER}
layout(location = 0) in vec3 position;  // 0..1 of the box of the mesh
layout(location = 1) in vec3 normal;
layout(location = 2) in vec3 color;
layout(location = 3) in vec3 place;
layout(location = 4) in vec4 turn;      // (w, x, y, z)
layout(location = 5) in float slot;
uniform mat4 viewProjection;
uniform vec3 low, size;
out vec3 point, facing, tint;
flat out float owner;

vec3 turned(vec3 v) { return v + 2.0 * cross(turn.yzw, cross(turn.yzw, v) + turn.x * v); }

void main() {
  point = place + turned(low + size * position);
  facing = turned(normal);
  tint = color;
  owner = slot;
  gl_Position = viewProjection * vec4(point, 1.0);
}`;

// How much of the sun reaches a point: percentage-closer filtering over a small disc of the sun's depth image.
const SUNLIGHT = `
uniform highp sampler2DShadow sunDepth;
uniform mat4 sunMatrix;
uniform float texel;  // m

float sunlight(vec3 point, vec3 normal) {
  vec3 at = (sunMatrix * vec4(point + 1.5 * texel * normal, 1.0)).xyz * 0.5 + 0.5;
  if (any(lessThan(at, vec3(0.0))) || any(greaterThan(at, vec3(1.0)))) return 1.0;
  vec2 pixel = 1.0 / vec2(textureSize(sunDepth, 0));
  float light = 0.0;
  for (int i = 0; i < 12; i++) {
    float r = sqrt((float(i) + 0.5) / 12.0) * 3.0, a = float(i) * 2.39996;
    light += texture(sunDepth, vec3(at.xy + r * pixel * vec2(cos(a), sin(a)), at.z));
  }
  return light / 12.0;
}`;

const OBJECT_FRAGMENT = `${HEADER}
in vec3 point, facing, tint;
flat in float owner;
uniform vec3 eye, toSun, classColor;
uniform bool byClass;
uniform float hovered, selected;
out vec4 result;
${SUNLIGHT}
void main() {
  vec3 normal = normalize(gl_FrontFacing ? facing : -facing);
  vec3 albedo = pow(byClass ? classColor : tint, vec3(2.2));
  if (owner == selected) albedo = mix(albedo, vec3(0.95, 0.22, 0.04), 0.55);
  else if (owner == hovered) albedo = mix(albedo, vec3(1.0, 0.75, 0.35), 0.35);
  vec3 sky = mix(vec3(0.38, 0.35, 0.33), vec3(0.64, 0.67, 0.72), 0.5 + 0.5 * normal.z);
  vec3 toEye = normalize(eye - point);
  float towards = max(dot(normal, toSun), 0.0);
  float sun = towards > 0.0 ? towards * sunlight(point, normal) : 0.0;
  float gloss = pow(max(dot(normal, normalize(toSun + toEye)), 0.0), 48.0) * 0.10;
  vec3 light = albedo * (sky + vec3(0.80, 0.77, 0.70) * sun) + gloss * sun;
  float brightest = max(light.r, max(light.g, light.b));
  light *= brightest > 0.8 ? (1.0 - 0.2 * exp((0.8 - brightest) / 0.2)) / brightest : 1.0;  // roll off, keep the hue
  result = vec4(pow(light, vec3(1.0 / 2.2)), 1.0);
}`;

const SLOT_FRAGMENT = `${HEADER}
flat in float owner;
out vec4 result;
void main() {
  int code = int(owner) + 1;
  result = vec4(float(code & 255), float(code >> 8), 0.0, 255.0) / 255.0;
}`;

const DEPTH_FRAGMENT = `${HEADER}
void main() {}`;

const SCREEN_VERTEX = `${HEADER}
out vec2 at;
void main() {
  at = vec2(float((gl_VertexID << 1) & 2), float(gl_VertexID & 2));
  gl_Position = vec4(2.0 * at - 1.0, 0.0, 1.0);
}`;

const BACKDROP_FRAGMENT = `${HEADER}
in vec2 at;
uniform vec3 upper, lower;
out vec4 result;
void main() { result = vec4(mix(lower, upper, at.y), 1.0); }`;

// The ground: invisible but for the shadow that falls on it.
const GROUND_VERTEX = `${HEADER}
uniform mat4 viewProjection;
uniform vec3 center;  // on the ground
uniform float reach;
out vec3 point;
void main() {
  vec2 corner = vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1)) * 2.0 - 1.0;
  point = center + vec3(reach * corner, 0.0);
  gl_Position = viewProjection * vec4(point, 1.0);
}`;

const GROUND_FRAGMENT = `${HEADER}
in vec3 point;
uniform vec3 center;
uniform float reach, strength;
out vec4 result;
${SUNLIGHT}
void main() {
  float fade = 1.0 - smoothstep(0.55, 1.0, length(point - center) / reach);
  result = vec4(vec3(0.0), strength * fade * (1.0 - sunlight(point, vec3(0.0, 0.0, 1.0))));
}`;

// Ambient occlusion: how much of the half space over a pixel's surface its surroundings close.
const OCCLUSION_FRAGMENT = `${HEADER}
in vec2 at;
uniform highp sampler2D depth;
uniform vec4 lens;    // tangents of the half angles, near, far
uniform float radius; // m
out vec4 result;

vec3 seen(vec2 uv) {
  float z = 2.0 * texture(depth, uv).r - 1.0;
  float away = 2.0 * lens.z * lens.w / (lens.w + lens.z - z * (lens.w - lens.z));
  return vec3((2.0 * uv - 1.0) * lens.xy * away, -away);
}

void main() {
  result = vec4(1.0);
  if (texture(depth, at).r == 1.0) return;
  vec2 pixel = 1.0 / vec2(textureSize(depth, 0));
  vec3 here = seen(at);
  vec3 left = here - seen(at - vec2(pixel.x, 0.0)), right = seen(at + vec2(pixel.x, 0.0)) - here;
  vec3 below = here - seen(at - vec2(0.0, pixel.y)), above = seen(at + vec2(0.0, pixel.y)) - here;
  vec3 across = abs(left.z) < abs(right.z) ? left : right, up = abs(below.z) < abs(above.z) ? below : above;
  vec3 normal = normalize(cross(across, up));
  vec2 reach = min(radius / (-here.z * lens.xy), vec2(0.12)) * 0.5;
  float start = 6.2832 * fract(52.9829 * fract(dot(gl_FragCoord.xy, vec2(0.06711, 0.00584))));
  float closed = 0.0;
  for (int i = 0; i < 16; i++) {
    float r = sqrt((float(i) + 0.5) / 16.0), a = start + float(i) * 2.39996;
    vec3 offset = seen(at + reach * r * vec2(cos(a), sin(a))) - here;
    float square = dot(offset, offset) + 1e-9;
    float rise = dot(offset, normal) * inversesqrt(square);
    closed += max(rise - 0.12, 0.0) * step(square, 4.0 * radius * radius);
  }
  result = vec4(1.0 - min(1.1 * closed / 16.0, 0.6));
}`;

const COMPOSITE_FRAGMENT = `${HEADER}
in vec2 at;
uniform sampler2D image, occlusion;
uniform highp sampler2D depth;
uniform vec4 lens;
out vec4 result;

float away(vec2 uv) {
  float z = 2.0 * texture(depth, uv).r - 1.0;
  return 2.0 * lens.z * lens.w / (lens.w + lens.z - z * (lens.w - lens.z));
}

void main() {  // the noise of the occlusion is averaged out over the pixels of the same surface
  vec2 pixel = 1.0 / vec2(textureSize(depth, 0));
  float here = away(at), sum = 0.0, weights = 0.0;
  for (int i = 0; i < 4; i++) for (int j = 0; j < 4; j++) {
    vec2 there = at + pixel * (vec2(float(i), float(j)) - 1.5);
    float weight = step(abs(away(there) - here), 0.02 * here) + 1e-4;
    sum += weight * texture(occlusion, there).r;
    weights += weight;
  }
  result = vec4(texture(image, at).rgb * (sum / weights), 1.0);
}`;
