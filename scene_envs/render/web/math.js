// Vectors, matrices (column-major, as WebGL wants them) and the orbit camera. World frame: z up, metres.

const radians = (degrees) => (degrees * Math.PI) / 180;
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
const add = (a, b) => a.map((value, i) => value + b[i]);
const subtract = (a, b) => a.map((value, i) => value - b[i]);
const scale = (a, factor) => a.map((value) => value * factor);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => scale(a, 1 / Math.hypot(...a));

function multiply(a, b) {
  const product = new Float32Array(16);
  for (let column = 0; column < 4; column++)
    for (let row = 0; row < 4; row++)
      for (let k = 0; k < 4; k++) product[4 * column + row] += a[4 * k + row] * b[4 * column + k];
  return product;
}

// World to a frame with the given axes (x right, y up, z backward) and origin.
function viewMatrix([right, up, backward], origin) {
  const [x, y, z] = [right, up, backward].map((axis) => -dot(axis, origin));
  return new Float32Array([
    right[0], up[0], backward[0], 0, right[1], up[1], backward[1], 0, right[2], up[2], backward[2], 0, x, y, z, 1,
  ]);
}

function perspective(fovY, aspect, near, far) {
  const focal = 1 / Math.tan(radians(fovY) / 2);
  const depth = near - far;
  return new Float32Array([
    focal / aspect, 0, 0, 0, 0, focal, 0, 0, 0, 0, (near + far) / depth, -1, 0, 0, (2 * near * far) / depth, 0,
  ]);
}

function orthographic(half, depth) {
  return new Float32Array([1 / half, 0, 0, 0, 0, 1 / half, 0, 0, 0, 0, -2 / depth, 0, 0, 0, -1, 1]);
}

// From the target to the camera; angles in degrees.
function direction(azimuth, elevation) {
  const [a, e] = [radians(azimuth), radians(elevation)];
  return [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
}

// Right, up and backward axes of a camera without roll.
function cameraAxes(azimuth, elevation) {
  const backward = direction(azimuth, elevation);
  const right = [-Math.sin(radians(azimuth)), Math.cos(radians(azimuth)), 0];
  return [right, cross(backward, right), backward];
}

// The nearest view in this direction that sees all points: its target and distance.
function fitView(points, azimuth, elevation, fovY, aspect, margin) {
  const axes = cameraAxes(azimuth, elevation);
  const slopeY = Math.tan(radians(fovY) / 2) * (1 - margin);
  const slopes = [slopeY * aspect, slopeY];
  const seen = points.map((point) => axes.map((axis) => dot(axis, point)));
  const extreme = (value) => Math.max(...seen.map(value));
  const most = slopes.map((slope, i) => extreme((p) => p[i] + slope * p[2]));
  const least = slopes.map((slope, i) => extreme((p) => -p[i] + slope * p[2]));
  const away = Math.max(...slopes.map((slope, i) => (most[i] + least[i]) / (2 * slope)));
  const middle = (extreme((p) => p[2]) - extreme((p) => -p[2])) / 2;
  const center = [(most[0] - least[0]) / 2, (most[1] - least[1]) / 2, middle];
  const target = [0, 1, 2].map((k) => center.reduce((sum, value, i) => sum + value * axes[i][k], 0));
  return { azimuth, elevation, target, distance: away - middle };
}

// The vector v turned by a quaternion (w, x, y, z).
function turnVector([w, ...axis], v) {
  return add(v, scale(cross(axis, add(cross(axis, v), scale(v, w))), 2));
}

// The corners of the bounding box of a mesh, where an object has them.
function boxCorners({ low, size }, { translation, quaternion }) {
  const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((k) => low.map((value, i) => value + ((k >> i) & 1) * size[i]));
  return corners.map((corner) => add(translation, turnVector(quaternion, corner)));
}

// Roll, pitch, yaw in degrees of a quaternion (w, x, y, z): rotations about the fixed x, y and z axes, in this order.
function rollPitchYaw([w, x, y, z]) {
  const degrees = (value) => (value * 180) / Math.PI;
  return [
    degrees(Math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))),
    degrees(Math.asin(clamp(2 * (w * y - z * x), -1, 1))),
    degrees(Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))),
  ];
}
