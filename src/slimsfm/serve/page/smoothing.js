/**
 * Smoothing of poses: the one-euro filter, on what remains after the gyroscope's turn.
 *
 * A still camera is smoothed, a moving one is followed at once, and a jump is taken as it is.
 *
 * Reference: Casiez, Roussel and Vogel, 1€ Filter, CHI 2012.
 */
import {
  NO_TURN, inverted, length, minus, multiply, normalized, fromRotationVector, plus, rotate, times, toRotationVector,
  transform, turned,
} from "./pose.js";

/** @typedef {import("./pose.js").Pose} Pose @typedef {import("./pose.js").Quaternion} Quaternion @typedef {import("./pose.js").Vector} Vector */

const JUMP = 0.15; // radians, or shift over depth, from one reply to the next: twice the fastest hand
const GAP_S = 0.5; // after as long without a pose, there is nothing to smooth with

/** Share of a new value in a low-pass filter. @param {number} cutoff Hertz. @param {number} seconds Since the value before. */
export function shareOf(cutoff, seconds) {
  return 1 / (1 + 1 / (2 * Math.PI * cutoff * seconds));
}

/** Says how far to follow a residual: the difference of a measured value to the filtered one. */
export class OneEuro {
  /** @param {{minCutoff?: number, beta?: number, speedCutoff?: number}} [options] Hertz, hertz per unit of speed, hertz. */
  constructor({ minCutoff = 1.5, beta = 30, speedCutoff = 1 } = {}) {
    Object.assign(this, { minCutoff, beta, speedCutoff });
    /** @type {number[] | null} */
    this.speed = null;
  }

  /** Share of the residual to follow. @param {number[]} residual @param {number} seconds Since the last call. */
  follow(residual, seconds) {
    const share = shareOf(this.speedCutoff, seconds);
    const before = this.speed ?? residual.map(() => 0);
    this.speed = residual.map((value, i) => before[i] + share * (value / seconds - before[i]));
    return shareOf(this.minCutoff + this.beta * length(this.speed), seconds);
  }
}

/** Smooths the poses of one object. */
export class PoseFilter {
  /** @param {Vector} center Of the object, in the world: it is what must stand still. */
  constructor(center) {
    this.center = center;
    this.reset();
  }

  reset() {
    /** @type {{seconds: number, pose: Pose} | null} */
    this.last = null;
    this.rotation = new OneEuro();
    this.place = new OneEuro();
  }

  /**
   * The smoothed pose.
   *
   * @param {number} seconds When the picture of the pose was taken.
   * @param {Pose} measured
   * @param {Quaternion} turn Of the camera since the last pose, by the gyroscope.
   * @returns {Pose}
   */
  smooth(seconds, measured, turn = NO_TURN) {
    const passed = this.last ? seconds - this.last.seconds : Infinity;
    if (passed <= 0 && this.last) return this.last.pose;
    const expected = this.last ? turned(turn, this.last.pose) : measured;
    const { rotation, place, depth } = this.residuals(expected, measured);
    const jumped = length(rotation) > JUMP || length(place) > JUMP;
    if (jumped || passed > GAP_S) this.reset();
    const pose = this.last ? this.corrected(expected, rotation, place, depth, passed) : measured;
    this.last = { seconds, pose };
    return pose;
  }

  /** Rotation in radians, and shift of the center over its depth. @param {Pose} expected @param {Pose} measured */
  residuals(expected, measured) {
    const [before, now] = [transform(expected, this.center), transform(measured, this.center)];
    const depth = Math.max(length(now), 1e-9);
    const rotation = toRotationVector(multiply(measured.rotation, inverted(expected.rotation)));
    return { rotation, place: times(minus(now, before), 1 / depth), depth };
  }

  /** @param {Pose} expected @param {Vector} rotation @param {Vector} place @param {number} depth @param {number} seconds @returns {Pose} */
  corrected(expected, rotation, place, depth, seconds) {
    const part = times(rotation, this.rotation.follow(rotation, seconds));
    const shift = times(place, depth * this.place.follow(place, seconds));
    const turn = normalized(multiply(fromRotationVector(part), expected.rotation));
    const center = plus(transform(expected, this.center), shift);
    return { rotation: turn, translation: minus(center, rotate(turn, this.center)) };
  }
}
