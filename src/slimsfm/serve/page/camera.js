/** Cameras and video files as sources of frames. */

/** @typedef {{label: string, turnsWithDevice: boolean, stop: () => void}} Source */

const WIDTH = 1280;
const HEIGHT = 720;

/** Why a camera cannot be used, in words for the user. @param {any} error */
export function cameraProblem(error) {
  const reasons = {
    NotAllowedError: "The camera is not allowed. Allow it for this page in the browser's settings, then start again.",
    NotFoundError: "There is no camera. Open a photo or a video instead.",
    NotReadableError: "Another program uses the camera. Close it, then start again.",
    OverconstrainedError: "This camera is gone. Choose another one.",
    InsecureError: "Browsers give cameras to secure pages only. Open the https address, or a photo.",
  };
  return reasons[/** @type {keyof typeof reasons} */ (error?.name)] ?? `The camera cannot be used: ${error?.message}`;
}

/**
 * Ask for a camera and play it. Must begin in the handler of a click.
 *
 * @param {HTMLVideoElement} video @param {string} deviceId Empty: the rear camera.
 * @returns {Promise<Source>}
 */
export async function openCamera(video, deviceId) {
  if (!navigator.mediaDevices) throw Object.assign(new Error("insecure"), { name: "InsecureError" });
  const which = deviceId ? { deviceId: { exact: deviceId } } : { facingMode: { ideal: "environment" } };
  const wanted = { ...which, width: { ideal: WIDTH }, height: { ideal: HEIGHT } };
  const stream = await navigator.mediaDevices.getUserMedia({ audio: false, video: wanted });
  const [track] = stream.getVideoTracks();
  video.srcObject = stream;
  await video.play();
  return {
    label: track.label || "camera",
    turnsWithDevice: track.getSettings().facingMode === "environment",
    stop: () => {
      stream.getTracks().forEach((one) => one.stop());
      video.srcObject = null;
    },
  };
}

/** The cameras; their names are known once one was allowed. @returns {Promise<MediaDeviceInfo[]>} */
export async function listCameras() {
  const devices = (await navigator.mediaDevices?.enumerateDevices()) ?? [];
  return devices.filter((device) => device.kind === "videoinput");
}

/** Play a video again and again. @param {HTMLVideoElement} video @param {Blob} file @param {string} name @returns {Promise<Source>} */
export async function openVideo(video, file, name) {
  const address = URL.createObjectURL(file);
  video.src = address;
  video.loop = true;
  const stop = () => {
    video.removeAttribute("src");
    video.load();
    URL.revokeObjectURL(address);
  };
  try {
    await video.play();
  } catch {
    stop();
    throw new Error(`${name}: this browser cannot play it.`);
  }
  return { label: `video ${name}`, turnsWithDevice: false, stop };
}

/**
 * Call back for each new frame of a video.
 *
 * @param {HTMLVideoElement} video @param {(captured: number) => void} onFrame With the time at which the frame was
 *   taken, in milliseconds of performance.now().
 * @returns {() => void} Ends it.
 */
export function watchFrames(video, onFrame) {
  let runs = true;
  let shown = -1;
  const next = () => {
    if (video.requestVideoFrameCallback) video.requestVideoFrameCallback((now, data) => step(data.captureTime ?? now));
    else requestAnimationFrame((now) => step(now));
  };
  const step = (/** @type {number} */ captured) => {
    if (!runs) return;
    next();
    if (!video.requestVideoFrameCallback && video.currentTime === shown) return;
    shown = video.currentTime;
    onFrame(captured);
  };
  next();
  return () => {
    runs = false;
  };
}

/** Ask for the device's orientation, which iOS gives on a click only. @param {import("./gyroscope.js").Gyroscope} gyroscope */
export async function openGyroscope(gyroscope) {
  const kind = /** @type {any} */ (window.DeviceOrientationEvent);
  if (!kind) return;
  const answer = await kind.requestPermission?.().catch(() => "denied");
  if (answer === "denied") return;
  window.addEventListener("deviceorientation", (event) => {
    gyroscope.add(event.timeStamp, event.alpha, event.beta, event.gamma);
  });
}
