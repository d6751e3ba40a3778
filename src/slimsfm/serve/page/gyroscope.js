/**
 * How a camera turned between two moments, from the device's orientation events.
 *
 * Orientation is used rather than the rates of devicemotion: its angles mean the same in all browsers, while the
 * standard has named the axes of rotation rates in two ways.
 */
import { NO_TURN, between, inverted, multiply, normalized } from "./pose.js";

/** @typedef {import("./pose.js").Quaternion} Quaternion */

const KEPT_MS = 2000;
const STALE_MS = 250; // without an event for as long, the sensor counts as missing
const DEGREE = Math.PI / 180;

/** @param {number} axis @param {number} radians @returns {Quaternion} */
function about(axis, radians) {
  /** @type {Quaternion} */
  const turn = [0, 0, 0, Math.cos(radians / 2)];
  turn[axis] = Math.sin(radians / 2);
  return turn;
}

/**
 * Orientation of a device: earth_from_device, with the device's x to the right of its screen in its natural
 * orientation, y to the top, z out of the screen.
 *
 * @param {number} alpha Degrees about z, first. @param {number} beta About x. @param {number} gamma About y, last.
 * @returns {Quaternion}
 */
export function earthFromDevice(alpha, beta, gamma) {
  const first = multiply(about(2, alpha * DEGREE), about(0, beta * DEGREE));
  return normalized(multiply(first, about(1, gamma * DEGREE)));
}

/**
 * The rear camera's frame, whose pictures are upright on the screen: camera_from_device.
 *
 * @param {number} screenAngle Degrees by which the screen's content is turned: `screen.orientation.angle`.
 * @returns {Quaternion}
 */
export function cameraFromDevice(screenAngle) {
  return multiply(about(0, Math.PI), about(2, screenAngle * DEGREE));
}

/**
 * The turn of the camera between two orientations: camera_later from camera_earlier.
 *
 * @param {Quaternion} earlier @param {Quaternion} later Both earth_from_device.
 * @param {number} screenAngle
 * @returns {Quaternion}
 */
export function cameraTurn(earlier, later, screenAngle) {
  const camera = cameraFromDevice(screenAngle);
  const device = multiply(inverted(later), earlier);
  return normalized(multiply(multiply(camera, device), inverted(camera)));
}

/** The orientations of the last seconds. */
export class Gyroscope {
  constructor() {
    /** @type {{time: number, orientation: Quaternion}[]} */
    this.samples = [];
  }

  /** @param {number} time Milliseconds. @param {number | null} alpha @param {number | null} beta @param {number | null} gamma */
  add(time, alpha, beta, gamma) {
    if (alpha === null || beta === null || gamma === null) return; // a device without the sensor sends one such event
    this.samples.push({ time, orientation: earthFromDevice(alpha, beta, gamma) });
    while (this.samples[0].time < time - KEPT_MS) this.samples.shift();
  }

  /** Whether orientations arrive. @param {number} now */
  runs(now) {
    const last = this.samples.at(-1);
    return last !== undefined && now - last.time < STALE_MS;
  }

  /** Orientation at a time; the nearest where there is no sample on one of its sides. @param {number} time @returns {Quaternion | null} */
  at(time) {
    const next = this.samples.findIndex((sample) => sample.time >= time);
    if (next < 0) return this.samples.at(-1)?.orientation ?? null;
    if (next === 0) return this.samples[0].orientation;
    const [a, b] = [this.samples[next - 1], this.samples[next]];
    return between(a.orientation, b.orientation, (time - a.time) / (b.time - a.time));
  }

  /** Turn of the rear camera between two times. @param {number} from @param {number} to @param {number} screenAngle @returns {Quaternion} */
  turn(from, to, screenAngle) {
    const [earlier, later] = [this.at(from), this.at(to)];
    return earlier && later ? cameraTurn(earlier, later, screenAngle) : NO_TURN;
  }
}
