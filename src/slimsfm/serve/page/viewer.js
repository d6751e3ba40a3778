/** The canvas: a picture with what is drawn over it, as large as fits. */
import { COLORS, DrawnObject } from "./objects.js";
import { Painter } from "./painter.js";
import { fromRotationVector, multiply, rotate, times } from "./pose.js";

/**
 * @typedef {import("./pose.js").Pose} Pose @typedef {import("./pose.js").Camera} Camera
 * @typedef {{object: DrawnObject, pose: Pose, camera: Camera, sure: boolean}} Overlay
 */

const MAX_DENSITY = 2; // canvas pixels per CSS pixel; more costs time and shows nothing
const PREVIEW_SHARE = 0.3;
const PREVIEW_TURN_S = 12;

export class Viewer {
  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas) {
    this.canvas = canvas;
    this.painter = new Painter(canvas);
    this.shown = { box: true, points: false, model: true };
    /** @type {{width: number, height: number} | null} */
    this.size = null;
    /** @type {Overlay | null} */
    this.overlay = null;
    new ResizeObserver(() => this.resize()).observe(canvas);
    canvas.addEventListener("webglcontextrestored", () => location.reload());
  }

  resize() {
    const density = Math.min(devicePixelRatio || 1, MAX_DENSITY);
    this.canvas.width = Math.max(1, Math.round(this.canvas.clientWidth * density));
    this.canvas.height = Math.max(1, Math.round(this.canvas.clientHeight * density));
    this.repaint();
  }

  /** Where the picture is on the canvas. @returns {import("./painter.js").Rectangle} */
  part() {
    const { width, height } = this.canvas;
    if (!this.size) return { x: 0, y: 0, width, height };
    const factor = Math.min(width / this.size.width, height / this.size.height);
    const [w, h] = [Math.round(this.size.width * factor), Math.round(this.size.height * factor)];
    return { x: Math.floor((width - w) / 2), y: Math.floor((height - h) / 2), width: w, height: h };
  }

  /**
   * Show a picture.
   *
   * @param {TexImageSource} source @param {{width: number, height: number}} size Of the picture.
   * @param {Overlay | null} overlay What to draw over it. @param {DrawnObject | null} [preview] What to look for.
   */
  show(source, size, overlay, preview = null) {
    this.size = size;
    this.overlay = overlay;
    this.painter.show(source, this.part());
    this.drawOver(preview);
    this.painter.mark();
  }

  /** Draw the last picture again, with other options or in another size. */
  repaint() {
    if (!this.size) return;
    this.painter.repaint(this.part());
    this.drawOver(null);
  }

  /** @param {DrawnObject | null} preview */
  drawOver(preview) {
    const { overlay } = this;
    if (overlay) overlay.object.draw(overlay.object.eye(overlay.pose, overlay.camera), this.shown, overlay.sure);
    else if (preview?.points) this.drawPreview(preview);
  }

  /** The turning points of an object, at the top right: this is what to look for. @param {DrawnObject} object */
  drawPreview(object) {
    const part = this.part();
    const side = Math.round(PREVIEW_SHARE * Math.min(part.width, part.height));
    const margin = Math.round(0.06 * side);
    const corner = { x: part.x + part.width - side - margin, y: part.y + part.height - side - margin };
    this.painter.blank({ ...corner, width: side, height: side }, COLORS.rim);
    const camera = { width: 1, height: 1, fx: 1.6, fy: 1.6, cx: 0.5, cy: 0.5, distortion: /** @type {[number, number, number, number]} */ ([0, 0, 0, 0]) };
    const eye = object.eye(orbit(object, performance.now() / 1000 / PREVIEW_TURN_S), camera);
    if (object.points) this.painter.drawPoints(object.points, eye, { width: Math.max(2, side / 70), core: 1 });
  }
}

/** A camera on its way around an object, whose third axis is taken as up. @param {DrawnObject} object @param {number} turns @returns {Pose} */
function orbit(object, turns) {
  const tilt = fromRotationVector([1.9, 0, 0]);
  const rotation = multiply(tilt, fromRotationVector([0, 0, 2 * Math.PI * turns]));
  const [x, y, z] = times(rotate(rotation, object.center), -1);
  return { rotation, translation: [x, y, z + 1.7 * object.diagonal] };
}
