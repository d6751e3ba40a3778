/** Intrinsics: from replies, and those of a device, whose focal length is kept from visit to visit. */

/** @typedef {import("./pose.js").Camera} Camera */

const NEEDED = 7; // confident estimates; the median of as many is within a percent or two
const CONFIDENT = 0.8;
const STORED = "slimsfm.focal";

/** Which of a model's parameters are k1, k2, p1, p2, in COLMAP's order; other models are drawn without distortion. */
const DISTORTION = {
  SIMPLE_RADIAL: [3],
  RADIAL: [3, 4],
  OPENCV: [4, 5, 6, 7],
};

/** The camera of a reply. @param {any} json @returns {Camera} */
export function cameraFrom(json) {
  const places = DISTORTION[/** @type {keyof typeof DISTORTION} */ (json.model)] ?? [];
  const [k1, k2, p1, p2] = places.map((place) => json.params?.[place] ?? 0);
  const { width, height, fx, fy, cx, cy } = json;
  return { width, height, fx, fy, cx, cy, distortion: [k1 ?? 0, k2 ?? 0, p1 ?? 0, p2 ?? 0] };
}

/** @param {number[]} values @returns {number} */
export function median(values) {
  const sorted = [...values].sort((a, b) => a - b);
  const middle = Math.floor(sorted.length / 2);
  return sorted.length % 2 ? sorted[middle] : (sorted[middle - 1] + sorted[middle]) / 2;
}

/** Focal lengths of devices in browser storage; without storage, nothing is known and nothing kept. */
export class KnownCameras {
  /** @param {Pick<Storage, "getItem" | "setItem"> | null} storage */
  constructor(storage) {
    this.storage = storage;
  }

  /** One key for both ways of holding a device. @param {string} device @param {number} width @param {number} height */
  static key(device, width, height) {
    return `${STORED} ${device} ${Math.max(width, height)}x${Math.min(width, height)}`;
  }

  /** @param {string} device @param {number} width @param {number} height @returns {{fx: number, fy: number, cx: number, cy: number} | null} */
  get(device, width, height) {
    try {
      const focal = Number(this.storage?.getItem(KnownCameras.key(device, width, height)));
      return focal > 0 && Number.isFinite(focal) ? { fx: focal, fy: focal, cx: width / 2, cy: height / 2 } : null;
    } catch {
      return null;
    }
  }

  /** @param {string} device @param {number} width @param {number} height @param {number} focal Pixels. */
  set(device, width, height, focal) {
    try {
      this.storage?.setItem(KnownCameras.key(device, width, height), focal.toFixed(2));
    } catch {
      // private windows may refuse to keep anything
    }
  }
}

/** Collects focal lengths that confident frames were found with, each estimated from its frame alone. */
export class FocalEstimates {
  constructor() {
    /** @type {number[]} */
    this.found = [];
  }

  /** @param {any} reply Of a frame that was localized with unknown focal length. @returns {number | null} The median, once there are enough. */
  add(reply) {
    const focal = reply.camera && (reply.camera.fx + reply.camera.fy) / 2;
    if (reply.found && (reply.confidence ?? 0) >= CONFIDENT && focal > 0) this.found.push(focal);
    return this.found.length >= NEEDED ? median(this.found) : null;
  }
}
