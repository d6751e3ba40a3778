/**
 * From the frames of a camera to a picture with the object's pose on it.
 *
 * An answer comes some 50 ms after its frame was taken, and meanwhile the camera has moved. There are two ways to draw
 * both together, and the page takes the better one of those it can:
 *
 * - With a gyroscope, the newest frame is shown, and the pose is carried to it by the camera's turn since. A turn is
 *   what moves the picture most: a hand that turns by 30 degrees per second moves it by 15 pixels in 50 ms.
 * - Without, the frame that was sent is kept, and shown when its answer comes. The drawing then fits exactly at any
 *   speed, and the picture is late by the time of an answer, which is less visible than a box that swims.
 *
 * Answers may take longer, on a slow network. A pose is then carried for CARRY_MS, because the gyroscope does not know
 * that the camera moved aside; a picture is held back for HOLD_MS. After that the newest picture is shown with nothing
 * on it: no box is better than a wrong one.
 */
import { cameraFrom } from "./cameras.js";
import { Copier, Encoder, FRAME_SIDE, SHOWN_SIDE, fitted } from "./encoding.js";
import { NO_TURN, poseFrom, turned } from "./pose.js";
import { PoseFilter } from "./smoothing.js";
import { directionTo, nextState } from "./states.js";
import { watchFrames } from "./camera.js";

/**
 * @typedef {import("./objects.js").DrawnObject} DrawnObject
 * @typedef {{pose: import("./pose.js").Pose, camera: import("./pose.js").Camera, captured: number, object: DrawnObject, sure: boolean}} Known
 * @typedef {{state: import("./states.js").State, name: string, confidence: number | null, direction: string, lag: number, rate: number, ms: any}} Report
 */

const HOLD_MS = 1500;
const CARRY_MS = 1000;
const ALONE_MS = 60; // between pictures alone, without a gyroscope: localization may need the same processor

/**
 * What is shown, at some time after the frame of the last pose was taken: that frame, the newest with the pose carried
 * to it, or the newest alone.
 *
 * @param {boolean} hasGyroscope @param {number} age Milliseconds.
 * @returns {"held" | "carried" | "alone"}
 */
export function manner(hasGyroscope, age) {
  if (hasGyroscope) return age <= CARRY_MS ? "carried" : "alone";
  return age <= HOLD_MS ? "held" : "alone";
}

export class Live {
  /**
   * @param {{video: HTMLVideoElement, viewer: import("./viewer.js").Viewer, gyroscope: import("./gyroscope.js").Gyroscope,
   *   socket: import("./socket.js").TrackSocket, objectOf: (id: string) => DrawnObject | null,
   *   preview: () => DrawnObject | null, onSize: (size: {width: number, height: number}) => void,
   *   onReport: (report: Report) => void, onFrameSent: (jpeg: ArrayBuffer, reply: any) => void}} parts
   */
  constructor(parts) {
    this.parts = parts;
    this.encoder = new Encoder();
    this.held = new Copier();
    this.alone = new Copier();
    /** @type {import("./camera.js").Source | undefined} */
    this.source = undefined;
    /** @type {(() => void) | null} */
    this.stopWatching = null;
    this.reset();
  }

  reset() {
    /** @type {import("./states.js").State} */
    this.state = "searching";
    /** @type {Known | null} */
    this.known = null;
    /** @type {Known | null} The last pose, however old, to say where the object went. */
    this.lastSeen = null;
    /** @type {{sequence: number, captured: number, picture: HTMLVideoElement | OffscreenCanvas | HTMLCanvasElement, jpeg: ArrayBuffer} | null} */
    this.sent = null;
    /** @type {Map<string, PoseFilter>} */
    this.filters = new Map();
    this.answered = /** @type {number[]} */ ([]);
    this.size = { width: 0, height: 0 };
    this.newest = this.lastSent = this.lastAlone = 0;
    this.encoding = false;
  }

  /** @param {import("./camera.js").Source} source That the video plays. */
  start(source) {
    this.reset();
    this.source = source;
    this.stopWatching = watchFrames(this.parts.video, (captured) => this.onFrame(captured));
  }

  stop() {
    this.stopWatching?.();
    this.stopWatching = null;
    this.source?.stop();
    this.source = undefined;
    this.sent = null;
  }

  get runs() {
    return this.stopWatching !== null;
  }

  /** @param {number} captured */
  onFrame(captured) {
    const { videoWidth: width, videoHeight: height } = this.parts.video;
    if (!width || !height) return;
    if (width !== this.size.width || height !== this.size.height) {
      this.size = { width, height };
      this.parts.onSize(fitted(width, height, FRAME_SIDE));
    }
    this.newest = captured;
    this.sendNewest();
    this.showNewest(captured);
  }

  /** Send the frame that the video shows, unless it was sent or another one is on its way. */
  async sendNewest() {
    if (!this.parts.socket.ready || this.encoding || this.newest === this.lastSent) return;
    const captured = (this.lastSent = this.newest);
    this.encoding = true;
    try {
      const picture = this.newestPicture(this.held);
      const jpeg = await this.encoder.jpeg(picture, fitted(this.size.width, this.size.height, FRAME_SIDE));
      if (!this.runs || !this.parts.socket.ready) return;
      this.sent = { sequence: this.parts.socket.send(captured, jpeg), captured, picture, jpeg };
    } catch {
      // the camera has no frame at the moment, such as while it is being switched
    } finally {
      this.encoding = false;
    }
  }

  /** @param {number} captured */
  showNewest(captured) {
    const { viewer, preview } = this.parts;
    const { known } = this;
    const how = known ? manner(this.hasGyroscope, captured - known.captured) : "alone";
    const isEarly = !this.hasGyroscope && captured - this.lastAlone < ALONE_MS;
    if (how === "held" || isEarly || viewer.painter.busy) return;
    const overlay = known && how === "carried" ? { ...known, pose: this.carried(known, captured) } : null;
    const isSought = this.state === "searching" || this.state === "lost";
    viewer.show(this.newestPicture(this.alone), this.size, overlay, isSought ? preview() : null);
    this.lastAlone = captured;
    if (known && how === "alone") this.waitFor(known);
  }

  /** The video, or a copy of its picture to keep, where no gyroscope brings a pose to the newest one. @param {Copier} copier */
  newestPicture(copier) {
    const { video } = this.parts;
    return this.hasGyroscope ? video : copier.copy(video, fitted(video.videoWidth, video.videoHeight, SHOWN_SIDE));
  }

  /** Say that answers are late. @param {Known} known */
  waitFor(known) {
    this.known = null;
    this.parts.onReport({
      state: "waiting", name: known.object.name, confidence: null, direction: "", lag: 0, rate: 0, ms: null,
    });
  }

  get hasGyroscope() {
    return Boolean(this.source?.turnsWithDevice) && this.parts.gyroscope.runs(performance.now());
  }

  /** @param {Known} known @param {number} time */
  carried(known, time) {
    return turned(this.turn(known.captured, time), known.pose);
  }

  /** @param {number} from @param {number} to */
  turn(from, to) {
    return this.hasGyroscope ? this.parts.gyroscope.turn(from, to, screen.orientation?.angle ?? 0) : NO_TURN;
  }

  /** @param {any} reply Of the frame that was sent last. */
  onPose(reply) {
    const { sent } = this;
    const now = performance.now();
    if (!this.runs || sent?.sequence !== reply.sequence) return;
    this.state = nextState(this.state, reply);
    const object = reply.found ? this.parts.objectOf(reply.map) : null;
    this.known = object && this.understood(reply, object, sent.captured);
    this.lastSeen = this.known ?? this.lastSeen;
    const { known } = this;
    const how = known && manner(this.hasGyroscope, now - sent.captured);
    if (how === "held") this.parts.viewer.show(sent.picture, this.size, known);
    this.parts.onFrameSent(sent.jpeg, reply);
    if (!known) this.showNewest(this.newest);
    if (known && how === "alone") this.waitFor(known);
    else this.report(reply, now - sent.captured, now);
    this.sendNewest();
  }

  /** @param {any} reply @param {DrawnObject} object @param {number} captured @returns {Known} */
  understood(reply, object, captured) {
    const filter = this.filters.get(object.name) ?? new PoseFilter(object.center);
    this.filters.set(object.name, filter);
    const turn = this.lastSeen ? this.turn(this.lastSeen.captured, captured) : NO_TURN;
    const pose = filter.smooth(captured / 1000, poseFrom(reply.cam_from_world), turn);
    return { pose, camera: cameraFrom(reply.camera), captured, object, sure: this.state === "found" };
  }

  /** @param {any} reply @param {number} lag @param {number} now */
  report(reply, lag, now) {
    this.answered = [...this.answered.filter((time) => time > now - 1000), now];
    const seen = this.lastSeen;
    const where = seen && this.hasGyroscope ? directionTo(this.carried(seen, now), seen.object.center, seen.camera) : "";
    this.parts.onReport({
      state: this.state, name: reply.found ? reply.map : (seen?.object.name ?? ""), confidence: reply.confidence ?? null,
      direction: where, lag, rate: this.answered.length, ms: reply.ms,
    });
  }
}
