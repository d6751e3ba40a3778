/** Pictures as JPEG for the server. They are drawn anew, so nothing but pixels leaves the device: no place, no names. */

export const FRAME_SIDE = 640; // longer side of frames: what the tracker works with
export const PHOTO_SIDE = 1920;
const QUALITY = 0.85;

/** Size with a longer side of at most so many pixels. @param {number} width @param {number} height @param {number} longest */
export function fitted(width, height, longest) {
  const factor = Math.min(1, longest / Math.max(width, height));
  return { width: Math.round(width * factor), height: Math.round(height * factor) };
}

/** Encodes pictures, one at a time. */
export class Encoder {
  constructor() {
    this.canvas = typeof OffscreenCanvas === "undefined" ? document.createElement("canvas") : new OffscreenCanvas(1, 1);
  }

  /** @param {CanvasImageSource} source @param {{width: number, height: number}} size Of the JPEG. @returns {Promise<ArrayBuffer>} */
  async jpeg(source, { width, height }) {
    const { canvas } = this;
    if (canvas.width !== width) canvas.width = width;
    if (canvas.height !== height) canvas.height = height;
    const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d", { alpha: false }));
    context.drawImage(source, 0, 0, width, height);
    const blob = await this.blob();
    if (!blob) throw new Error("The browser cannot encode the picture.");
    return blob.arrayBuffer();
  }

  /** @returns {Promise<Blob | null>} */
  blob() {
    const { canvas } = this;
    if ("convertToBlob" in canvas) return canvas.convertToBlob({ type: "image/jpeg", quality: QUALITY });
    return new Promise((done) => canvas.toBlob(done, "image/jpeg", QUALITY));
  }
}
