/**
 * Rotations, poses and projection, in COLMAP's frames: a camera looks along +z, x is right, y is down, and the
 * center of the top-left pixel is (0.5, 0.5).
 *
 * @typedef {[number, number, number]} Vector
 * @typedef {[number, number, number, number]} Quaternion x, y, z, w, of length 1.
 * @typedef {{rotation: Quaternion, translation: Vector}} Pose x_in_target = rotation * x_in_source + translation.
 * @typedef {{width: number, height: number, fx: number, fy: number, cx: number, cy: number,
 *   distortion: [number, number, number, number]}} Camera Pixels, and k1, k2, p1, p2 of COLMAP's model OPENCV.
 */

/** @type {Quaternion} */
export const NO_TURN = [0, 0, 0, 1];

/** @param {number[]} a @param {number[]} b */
export function dot(a, b) {
  return a.reduce((sum, value, i) => sum + value * b[i], 0);
}

/** @param {number[]} a */
export function length(a) {
  return Math.sqrt(dot(a, a));
}

/** @param {Vector} a @param {Vector} b @returns {Vector} */
export function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

/** @param {Vector} a @param {Vector} b @returns {Vector} */
export function plus(a, b) {
  return [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
}

/** @param {Vector} a @param {number} factor @returns {Vector} */
export function times(a, factor) {
  return [a[0] * factor, a[1] * factor, a[2] * factor];
}

/** @param {Vector} a @param {Vector} b @returns {Vector} */
export function minus(a, b) {
  return [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
}

/** @param {Quaternion} q @returns {Quaternion} */
export function normalized(q) {
  const size = length(q);
  return [q[0] / size, q[1] / size, q[2] / size, q[3] / size];
}

/** The rotation that first applies b, then a. @param {Quaternion} a @param {Quaternion} b @returns {Quaternion} */
export function multiply(a, b) {
  return [
    a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1],
    a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0],
    a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3],
    a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2],
  ];
}

/** The inverse rotation. @param {Quaternion} q @returns {Quaternion} */
export function inverted(q) {
  return [-q[0], -q[1], -q[2], q[3]];
}

/** @param {Quaternion} q @param {Vector} v @returns {Vector} */
export function rotate(q, v) {
  const axis = /** @type {Vector} */ ([q[0], q[1], q[2]]);
  const twice = times(cross(axis, v), 2);
  return plus(v, plus(times(twice, q[3]), cross(axis, twice)));
}

/** The rotation about an axis by its length in radians. @param {Vector} turn @returns {Quaternion} */
export function fromRotationVector(turn) {
  const angle = length(turn);
  const factor = angle < 1e-9 ? 0.5 : Math.sin(angle / 2) / angle;
  return normalized([turn[0] * factor, turn[1] * factor, turn[2] * factor, Math.cos(angle / 2)]);
}

/** Axis times angle in radians, at most pi. @param {Quaternion} q @returns {Vector} */
export function toRotationVector(q) {
  const sign = q[3] < 0 ? -1 : 1;
  const axis = /** @type {Vector} */ ([sign * q[0], sign * q[1], sign * q[2]]);
  const sine = length(axis);
  return times(axis, sine < 1e-9 ? 2 : (2 * Math.atan2(sine, sign * q[3])) / sine);
}

/** The rotation at a share of the way from a to b. @param {Quaternion} a @param {Quaternion} b @param {number} share @returns {Quaternion} */
export function between(a, b, share) {
  const turn = toRotationVector(multiply(b, inverted(a)));
  return normalized(multiply(fromRotationVector(times(turn, share)), a));
}

/** @param {Pose} pose @param {Vector} point @returns {Vector} */
export function transform(pose, point) {
  return plus(rotate(pose.rotation, point), pose.translation);
}

/** The camera's pose after a turn about its center. @param {Quaternion} turn @param {Pose} pose @returns {Pose} */
export function turned(turn, pose) {
  return {
    rotation: normalized(multiply(turn, pose.rotation)),
    translation: rotate(turn, pose.translation),
  };
}

/** Where a camera stands. @param {Pose} camFromWorld @returns {Vector} */
export function centerOf(camFromWorld) {
  return times(rotate(inverted(camFromWorld.rotation), camFromWorld.translation), -1);
}

/** The pose with the keys of the server's replies. @param {any} json @returns {Pose} */
export function poseFrom(json) {
  return { rotation: normalized(json.quaternion_xyzw), translation: json.translation };
}

/** Pixel of a point in the camera's frame, or null unless it is in front. @param {Vector} point @param {Camera} camera @returns {[number, number] | null} */
export function project(point, camera) {
  if (point[2] <= 0) return null;
  const [k1, k2, p1, p2] = camera.distortion;
  const x = point[0] / point[2];
  const y = point[1] / point[2];
  const square = x * x + y * y;
  const radial = 1 + square * (k1 + square * k2);
  const u = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x);
  const v = y * radial + 2 * p2 * x * y + p1 * (square + 2 * y * y);
  return [camera.fx * u + camera.cx, camera.fy * v + camera.cy];
}
