/** Matrices for WebGL, column by column, from poses and cameras. */

/** @typedef {import("./pose.js").Pose} Pose @typedef {import("./pose.js").Camera} Camera */

/**
 * From the camera's frame to clip coordinates: pixel (0, 0) is the top left of the viewport.
 *
 * @param {Camera} camera
 * @param {number} near Smallest depth that is drawn.
 * @param {number} far Largest.
 * @returns {Float32Array}
 */
export function projectionMatrix(camera, near, far) {
  const { width, height, fx, fy, cx, cy } = camera;
  const depth = far - near;
  return new Float32Array([
    (2 * fx) / width, 0, 0, 0,
    0, (-2 * fy) / height, 0, 0,
    (2 * cx) / width - 1, 1 - (2 * cy) / height, (far + near) / depth, 1,
    0, 0, (-2 * far * near) / depth, 0,
  ]);
}

/** From the world to the camera's frame. @param {Pose} camFromWorld @returns {Float32Array} */
export function viewMatrix(camFromWorld) {
  const [x, y, z, w] = camFromWorld.rotation;
  const [tx, ty, tz] = camFromWorld.translation;
  return new Float32Array([
    1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w), 0,
    2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w), 0,
    2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y), 0,
    tx, ty, tz, 1,
  ]);
}
