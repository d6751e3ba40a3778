/** What the page says about the object: searching, found, unsure, lost or waiting for an answer,
 * and where to look. */
import { project, transform } from "./pose.js";

/** @typedef {"searching" | "found" | "unsure" | "lost" | "waiting"} State @typedef {import("./pose.js").Pose} Pose @typedef {import("./pose.js").Camera} Camera @typedef {import("./pose.js").Vector} Vector */

const SURE = 0.6; // confidence of a pose that is shown without doubt

/** The state after a reply. @param {State} before @param {{found: boolean, confidence?: number | null}} reply @returns {State} */
export function nextState(before, reply) {
  if (!reply.found) return before === "searching" ? "searching" : "lost";
  return (reply.confidence ?? 1) < SURE ? "unsure" : "found";
}

/**
 * Where to turn the camera to see a point: "" if it is in the picture.
 *
 * @param {Pose} camFromWorld @param {Vector} point In the world. @param {Camera} camera
 * @returns {"" | "left" | "right" | "up" | "down" | "around"}
 */
export function directionTo(camFromWorld, point, camera) {
  const [x, y, z] = transform(camFromWorld, point);
  const pixel = project([x, y, z], { ...camera, distortion: [0, 0, 0, 0] });
  if (pixel && pixel[0] >= 0 && pixel[0] <= camera.width && pixel[1] >= 0 && pixel[1] <= camera.height) return "";
  if (z < 0 && Math.hypot(x, y) < -z / 2) return "around";
  if (Math.abs(x) * camera.fx * camera.height >= Math.abs(y) * camera.fy * camera.width) return x < 0 ? "left" : "right";
  return y < 0 ? "up" : "down";
}

const TURNS = { left: "← Turn left", right: "Turn right →", up: "↑ Tilt up", down: "↓ Tilt down", around: "Turn around" };

/**
 * Words for a state.
 *
 * @param {State} state
 * @param {{name: string, confidence: number | null, direction: string}} about
 * @returns {{title: string, hint: string}}
 */
export function wordsFor(state, { name, confidence, direction }) {
  const sure = confidence === null ? "" : ` · ${Math.round(100 * confidence)} %`;
  if (state === "found") return { title: `${name}${sure}`, hint: "" };
  if (state === "unsure") return { title: `Unsure: ${name}${sure}`, hint: "Go closer, or look at another side." };
  if (state === "lost") {
    const turn = TURNS[/** @type {keyof typeof TURNS} */ (direction)];
    return { title: `Lost ${name}`, hint: turn ?? "Point the camera back to where it was." };
  }
  if (state === "waiting") return { title: `Waiting: ${name}`, hint: "The server or the network is slow." };
  return { title: "Searching", hint: `Point the camera at ${name}, so that it fills a third of the picture.` };
}
