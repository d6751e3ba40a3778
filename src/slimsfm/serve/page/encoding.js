/** Pictures as JPEG for the server. They are drawn anew, so nothing but pixels leaves the device: no place, no names. */

export const FRAME_SIDE = 640; // longer side of frames: what the tracker works with
export const SHOWN_SIDE = 1280; // of frames as they are shown
export const PHOTO_SIDE = 1920;
const QUALITY = 0.85;

/** Size with a longer side of at most so many pixels. @param {number} width @param {number} height @param {number} longest */
export function fitted(width, height, longest) {
  const factor = Math.min(1, longest / Math.max(width, height));
  return { width: Math.round(width * factor), height: Math.round(height * factor) };
}

/** A canvas for drawing by the processor, which then has the pixels: reading them back from the GPU takes longer. */
function canvasOf(/** @type {number} */ width, /** @type {number} */ height) {
  if (typeof OffscreenCanvas !== "undefined") return new OffscreenCanvas(width, height);
  return Object.assign(document.createElement("canvas"), { width, height });
}

/** Draws pictures in a size, one at a time, on the same canvas. */
export class Copier {
  constructor() {
    this.canvas = canvasOf(1, 1);
    const options = { alpha: false, willReadFrequently: true };
    this.context = /** @type {CanvasRenderingContext2D} */ (this.canvas.getContext("2d", options));
  }

  /** @param {CanvasImageSource} source @param {{width: number, height: number}} size */
  copy(source, { width, height }) {
    const { canvas } = this;
    if (canvas.width !== width) canvas.width = width;
    if (canvas.height !== height) canvas.height = height;
    this.context.drawImage(source, 0, 0, width, height);
    return canvas;
  }
}

/** Encodes pictures, one at a time. */
export class Encoder {
  constructor() {
    this.copier = new Copier();
  }

  /** @param {CanvasImageSource} source @param {{width: number, height: number}} size Of the JPEG. @returns {Promise<ArrayBuffer>} */
  async jpeg(source, size) {
    const blob = await encoded(this.copier.copy(source, size));
    if (!blob) throw new Error("The browser cannot encode the picture.");
    return blob.arrayBuffer();
  }
}

/** @param {OffscreenCanvas | HTMLCanvasElement} canvas @returns {Promise<Blob | null>} */
function encoded(canvas) {
  if ("convertToBlob" in canvas) return canvas.convertToBlob({ type: "image/jpeg", quality: QUALITY });
  return new Promise((done) => canvas.toBlob(done, "image/jpeg", QUALITY));
}
