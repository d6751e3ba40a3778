/** The edges of a box, those in front and those behind. */
import { centerOf, dot, minus } from "./pose.js";

/** @typedef {import("./pose.js").Vector} Vector @typedef {import("./pose.js").Pose} Pose */

const PIECES = 8; // of an edge, so that it bends as the lens does

/** Corner k is at the binary digits of k, first axis first: two corners share an edge if one digit differs. */
const EDGES = [0, 1, 2, 3, 4, 5, 6, 7].flatMap((from) =>
  [1, 2, 4].filter((digit) => !(from & digit)).map((digit) => ({ from, to: from | digit, digit })),
);

/** Pieces of the edges. @param {Vector[]} corners Eight. @returns {Vector[][]} Pairs of points. */
export function edgePieces(corners) {
  return EDGES.flatMap(({ from, to }) => pieces(corners[from], corners[to]));
}

/** @param {Vector} a @param {Vector} b @returns {Vector[][]} */
function pieces(a, b) {
  /** @param {number} i @returns {Vector} */
  const at = (i) => [0, 1, 2].map((k) => a[k] + ((b[k] - a[k]) * i) / PIECES);
  return Array.from({ length: PIECES }, (_, i) => [at(i), at(i + 1)]);
}

/**
 * Which of the twelve edges the box hides from a camera: those between two faces that face away.
 *
 * @param {Vector[]} corners @param {Pose} camFromWorld
 * @returns {boolean[]}
 */
export function hiddenEdges(corners, camFromWorld) {
  const eye = centerOf(camFromWorld);
  return EDGES.map(({ from, digit }) =>
    [1, 2, 4].filter((other) => other !== digit).every((other) => !facesEye(corners, from, other, eye)),
  );
}

/** Whether the face of a corner whose normal is along a digit's axis faces a point. @param {Vector[]} corners @param {number} corner @param {number} digit @param {Vector} eye */
function facesEye(corners, corner, digit, eye) {
  const outward = minus(corners[corner], corners[corner ^ digit]);
  return dot(outward, minus(eye, corners[corner])) > 0;
}

/** @param {Vector[]} corners @returns {Vector} */
export function centerOfBox(corners) {
  return [0, 1, 2].map((k) => corners.reduce((sum, corner) => sum + corner[k] / 8, 0));
}

/** Three axes from a point. @param {Vector} origin @param {number} size @returns {Vector[][]} Pairs of points. */
export function axes(origin, size) {
  return [0, 1, 2].map((axis) => [origin, origin.map((value, k) => value + (k === axis ? size : 0))]);
}
