/** What is drawn of a map: its box, its points, and a model or axes. */
import { axes, centerOfBox, edgePieces, hiddenEdges } from "./box.js";

/**
 * @typedef {import("./painter.js").Painter} Painter @typedef {import("./painter.js").Eye} Eye
 * @typedef {import("./painter.js").Shape} Shape @typedef {import("./pose.js").Vector} Vector
 * @typedef {{box: boolean, points: boolean, model: boolean}} Shown
 */

/** Colors that stand out against photos: a bright one on a dark rim. */
export const COLORS = {
  found: /** @type {[number, number, number]} */ ([0.09, 0.95, 0.7]),
  unsure: /** @type {[number, number, number]} */ ([1, 0.77, 0.24]),
  rim: /** @type {[number, number, number]} */ ([0.02, 0.03, 0.04]),
};
const AXES = /** @type {[number, number, number][]} */ ([[1, 0.3, 0.33], [0.35, 0.9, 0.35], [0.35, 0.6, 1]]);
const POINT_SHARE = 1 / 240; // width of a point over that of the picture
const LINE_SHARE = 1 / 200;

/** An object on the GPU. */
export class DrawnObject {
  /** @param {Painter} painter @param {any} info `GET /v1/maps/{id}`. */
  constructor(painter, info) {
    this.painter = painter;
    this.name = info.id;
    this.corners = /** @type {Vector[]} */ (info.box.corners);
    this.center = centerOfBox(this.corners);
    this.diagonal = info.box.diagonal;
    this.edges = edgePieces(this.corners);
    this.axes = painter.lines(axes(this.center, 0.3 * this.diagonal), AXES);
    this.pattern = "";
    /** @type {Shape | null} */
    this.points = null;
    /** @type {{shape: Shape, texture: WebGLTexture | null} | null} */
    this.model = null;
  }

  /** @param {any} data `GET /v1/maps/{id}/points`. */
  setPoints({ count, positions, colors }) {
    const from = { data: new Float32Array(positions.flat()), size: 3 };
    const tint = { data: new Float32Array(colors.flat()).map((value) => value / 255), size: 3 };
    this.points = count ? this.painter.shape({ from, tint }, count) : null;
  }

  /** @param {any} data `GET /v1/maps/{id}/model`. */
  async setModel({ positions, normals, uvs, colors, indices, texture }) {
    const { painter } = this;
    const attributes = {
      from: { data: new Float32Array(positions), size: 3 },
      normal: { data: new Float32Array(normals), size: 3 },
      texel: { data: new Float32Array(uvs), size: 2 },
      tint: { data: new Float32Array(colors), size: 3 },
    };
    const shape = painter.shape(attributes, indices.length, new Uint32Array(indices));
    this.model = { shape, texture: texture ? await loaded(painter, texture) : null };
  }

  /** @param {import("./pose.js").Pose} pose @param {import("./pose.js").Camera} camera @returns {Eye} */
  eye(pose, camera) {
    return { pose, camera, near: 0.01 * this.diagonal, far: 100 * this.diagonal };
  }

  /** @param {Eye} eye @param {Shown} shown @param {boolean} sure */
  draw(eye, shown, sure) {
    const { painter } = this;
    const { width, height } = painter.part;
    if (shown.points && this.points) {
      painter.drawPoints(this.points, eye, { width: Math.max(3, POINT_SHARE * Math.hypot(width, height)), opacity: 0.9 });
    }
    if (shown.model && this.model) painter.drawMesh(this.model.shape, eye, this.model.texture);
    if (shown.model && !this.model) this.drawRimmed(this.axes, eye, undefined, false);
    if (shown.box) this.drawBox(eye, sure ? COLORS.found : COLORS.unsure);
  }

  /** Hidden edges are thin and faint. @param {Eye} eye @param {[number, number, number]} color */
  drawBox(eye, color) {
    this.split(hiddenEdges(this.corners, eye.pose));
    const deep = this.model !== null;
    const { hidden, visible } = this;
    if (hidden) this.painter.drawLines(hidden, eye, { width: this.lineWidth / 2, opacity: 0.45, paint: color, deep });
    if (visible) this.drawRimmed(visible, eye, color, deep);
  }

  get lineWidth() {
    const { width, height } = this.painter.part;
    return Math.max(2.5, LINE_SHARE * Math.hypot(width, height));
  }

  /** @param {Shape} lines @param {Eye} eye @param {[number, number, number] | undefined} paint @param {boolean} deep */
  drawRimmed(lines, eye, paint, deep) {
    const width = this.lineWidth;
    this.painter.drawLines(lines, eye, { width: 2 * width, opacity: 0.6, paint: COLORS.rim });
    this.painter.drawLines(lines, eye, { width, paint, deep });
  }

  /** Upload the edges again, if others are hidden than before. @param {boolean[]} isHidden Of the twelve edges. */
  split(isHidden) {
    const pattern = isHidden.join();
    if (pattern === this.pattern) return;
    const perEdge = this.edges.length / isHidden.length;
    const of = (/** @type {boolean} */ which) => this.edges.filter((_, i) => isHidden[Math.floor(i / perEdge)] === which);
    this.pattern = pattern;
    this.hidden = this.linesOf(of(true));
    this.visible = this.linesOf(of(false));
  }

  /** @param {Vector[][]} segments @returns {Shape | null} */
  linesOf(segments) {
    return segments.length ? this.painter.lines(segments, segments.map(() => COLORS.found)) : null;
  }
}

/** @param {Painter} painter @param {string} address Of an image. */
async function loaded(painter, address) {
  const image = new Image();
  image.src = address;
  await image.decode();
  const texture = painter.texture(true);
  painter.fill(texture, image, { flipped: true, shrunk: true });
  return texture;
}
