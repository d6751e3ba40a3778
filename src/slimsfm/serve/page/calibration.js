/**
 * Finds the focal length of a device's camera: some frames are localized once more, each on its own and with unknown
 * focal length, and the median is kept. Frames within a session share what its first frame gave, so they are no evidence.
 */
import { FocalEstimates, KnownCameras } from "./cameras.js";

const PAUSE_MS = 500; // between frames, so that the camera moves and tracking goes on
const CONFIDENT = 0.8;

export class Calibration {
  /** @param {import("./api.js").Api} api @param {KnownCameras} known @param {() => void} onFound */
  constructor(api, known, onFound) {
    this.api = api;
    this.known = known;
    this.onFound = onFound;
    this.begin("", { width: 0, height: 0 });
  }

  /** Begin with another camera. @param {string} device @param {{width: number, height: number}} size Of its frames. */
  begin(device, size) {
    this.device = device;
    this.size = size;
    this.estimates = new FocalEstimates();
    this.nextAt = 0;
    this.busy = false;
  }

  /** Intrinsics for a hello, or null. */
  get camera() {
    return this.known.get(this.device, this.size.width, this.size.height);
  }

  /** Use a frame that was found. @param {ArrayBuffer} jpeg @param {any} reply */
  async use(jpeg, reply) {
    const now = performance.now();
    const isSure = reply.found && (reply.confidence ?? 0) >= CONFIDENT;
    if (!isSure || this.busy || now < this.nextAt || this.camera) return;
    const { device, size, estimates } = this;
    this.busy = true;
    this.nextAt = now + PAUSE_MS;
    const found = await this.api.localize(jpeg, [reply.map], true).catch(() => null);
    if (this.estimates !== estimates) return;
    this.busy = false;
    const focal = found && estimates.add(found);
    if (!focal) return;
    this.known.set(device, size.width, size.height, focal);
    if (this.camera) this.onFound();
  }
}
