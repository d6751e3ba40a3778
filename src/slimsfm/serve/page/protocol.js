/** Messages of the WebSocket `/v1/track`. */

const VERSION = 1;
const HEADER_BYTES = 16;
const UPRIGHT = 1; // EXIF's orientation: browsers turn the pictures of cameras

/**
 * The first message.
 *
 * @param {{maps: string[], width: number, height: number, camera: object | null, token: string}} what
 */
export function hello({ maps, width, height, camera, token }) {
  return JSON.stringify({ type: "hello", version: VERSION, maps, width, height, camera, token });
}

/**
 * A frame: header and JPEG.
 *
 * @param {number} sequence @param {number} captured Milliseconds of this page's clock. @param {ArrayBuffer} jpeg
 * @returns {Uint8Array}
 */
export function frameMessage(sequence, captured, jpeg) {
  const message = new Uint8Array(HEADER_BYTES + jpeg.byteLength);
  const header = new DataView(message.buffer, 0, HEADER_BYTES);
  header.setUint8(0, VERSION);
  header.setUint8(1, UPRIGHT);
  header.setUint32(4, sequence, true);
  header.setFloat64(8, captured, true);
  message.set(new Uint8Array(jpeg), HEADER_BYTES);
  return message;
}

/** A message of the server, or null where it is none. @param {unknown} data @returns {any} */
export function parsed(data) {
  try {
    const message = typeof data === "string" ? JSON.parse(data) : null;
    return message && typeof message.type === "string" ? message : null;
  } catch {
    return null;
  }
}
