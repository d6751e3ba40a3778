/** The page: what buttons, pickers and dropped files do. */
import { Api, takeToken } from "./api.js";
import { Calibration } from "./calibration.js";
import { cameraProblem, listCameras, openCamera, openGyroscope, openVideo } from "./camera.js";
import { KnownCameras, cameraFrom } from "./cameras.js";
import { Encoder, PHOTO_SIDE, fitted } from "./encoding.js";
import { Gyroscope } from "./gyroscope.js";
import { Live } from "./live.js";
import { DrawnObject } from "./objects.js";
import { Panel, element } from "./panel.js";
import { poseFrom } from "./pose.js";
import { TrackSocket } from "./socket.js";
import { nextState } from "./states.js";
import { Viewer } from "./viewer.js";

/** Storage of the browser, or null where it is refused. @param {"localStorage" | "sessionStorage"} kind @returns {any} */
function storageOf(kind) {
  try {
    return window[kind];
  } catch {
    return null;
  }
}

class Page {
  constructor() {
    this.panel = new Panel();
    const noStorage = { getItem: () => null, setItem: () => {} };
    this.token = takeToken(location, history, storageOf("sessionStorage") ?? noStorage);
    this.api = new Api(document.baseURI, this.token);
    this.viewer = new Viewer(element("view"));
    this.gyroscope = new Gyroscope();
    /** @type {Map<string, DrawnObject>} */
    this.objects = new Map();
    /** @type {Set<string>} */
    this.asked = new Set();
    this.deviceId = "";
    this.resumes = false;
    this.socket = new TrackSocket(this.api.track, {
      onPose: (reply) => this.live.onPose(reply),
      onWelcome: () => this.live.sendNewest(),
      onProblem: (text, isFinal) => this.onProblem(text, isFinal),
    });
    this.calibration = new Calibration(this.api, new KnownCameras(storageOf("localStorage")), () => this.greet());
    this.live = this.liveView();
  }

  liveView() {
    const { viewer, gyroscope, socket } = this;
    return new Live({
      video: element("video"), viewer, gyroscope, socket,
      objectOf: (id) => this.objectOf(id),
      preview: () => this.preview(),
      onSize: (size) => this.onSize(size),
      onReport: (report) => this.panel.report(report, this.wanted),
      onFrameSent: (jpeg, reply) => this.calibration.use(jpeg, reply),
    });
  }

  /** Ids of the maps to search. */
  get chosen() {
    const id = element("map").value;
    return id ? [id] : [];
  }

  get wanted() {
    return this.chosen[0] ?? (this.maps?.length === 1 ? this.maps[0].id : "an object");
  }

  async load() {
    const { maps, film } = await this.api.maps();
    this.maps = maps;
    element("film").hidden = !film;
    const all = this.maps.length > 1 ? [{ value: "", label: "All objects" }] : [];
    this.panel.fill("map", [...all, ...this.maps.map(({ id }) => ({ value: id, label: id }))], "");
    if (this.maps.length === 1) this.objectOf(this.maps[0].id);
    this.panel.say("idle", "Ready", "Start the camera, or drop a photo or a video here.");
    if (film && new URLSearchParams(location.search).has("film")) await this.playFilm();
  }

  /** Play the server's film as the camera. */
  playFilm() {
    return this.play(async () => openVideo(element("video"), await this.api.film(), "film"));
  }

  /** What is drawn of a map; null until its box has come. @param {string} id */
  objectOf(id) {
    if (!this.asked.has(id)) {
      this.asked.add(id);
      this.fetchObject(id).catch(() => this.asked.delete(id));
    }
    return this.objects.get(id) ?? null;
  }

  /** @param {string} id */
  async fetchObject(id) {
    const info = await this.api.json(`v1/maps/${encodeURIComponent(id)}`);
    const object = new DrawnObject(this.viewer.painter, info);
    this.objects.set(id, object);
    object.setPoints(await this.api.points(id));
    if (info.model) await object.setModel(await this.api.model(id));
    this.viewer.repaint();
  }

  preview() {
    const id = this.chosen[0] ?? (this.maps?.length === 1 ? this.maps[0].id : "");
    return id ? this.objectOf(id) : null;
  }

  /** Play a source. @param {() => Promise<import("./camera.js").Source>} open */
  async play(open) {
    this.stop();
    this.panel.say("starting", "Starting …");
    try {
      const source = await open();
      this.live.start(source);
      this.panel.running(true);
      this.panel.say("searching", "Searching", `Point the camera at ${this.wanted}.`);
    } catch (error) {
      this.panel.running(false);
      this.panel.say("failed", "Nothing to show", /** @type {Error} */ (error).message);
    }
  }

  /** In the handler of a click, because iOS asks for both permissions there only. */
  startCamera() {
    const orientation = openGyroscope(this.gyroscope);
    return this.play(async () => {
      try {
        const source = await openCamera(element("video"), this.deviceId);
        await orientation;
        await this.nameCameras();
        return source;
      } catch (error) {
        throw new Error(cameraProblem(error));
      }
    });
  }

  async nameCameras() {
    const cameras = await listCameras();
    const options = cameras.map(({ deviceId, label }, i) => ({ value: deviceId, label: label || `Camera ${i + 1}` }));
    const playing = element("video").srcObject?.getVideoTracks()[0]?.getSettings().deviceId ?? "";
    this.panel.fill("camera", options, playing);
  }

  stop() {
    this.live.stop();
    this.socket.close();
    this.panel.running(false);
  }

  /** @param {{width: number, height: number}} size Of the frames that are sent. */
  onSize(size) {
    this.calibration.begin(this.live.source?.label ?? "", size);
    this.greet();
  }

  greet() {
    const { camera, size } = this.calibration;
    if (this.live.runs) this.socket.begin({ maps: this.chosen, ...size, camera, token: this.token });
  }

  /** @param {string} text @param {boolean} isFinal */
  onProblem(text, isFinal) {
    if (isFinal) this.stop();
    this.panel.say(isFinal ? "failed" : "searching", isFinal ? "Stopped" : "No connection", text);
  }

  /** @param {File | undefined} file A photo or a video. */
  async open(file) {
    if (!file) return;
    if (file.type.startsWith("video/")) return this.play(() => openVideo(element("video"), file, file.name));
    this.stop();
    this.panel.say("starting", "Looking …");
    try {
      await this.localize(await createImageBitmap(file));
    } catch (error) {
      const text = error instanceof DOMException ? `${file.name}: this browser cannot read it.` : error.message;
      this.panel.say("failed", "Nothing to show", text);
    }
  }

  /** @param {ImageBitmap} picture */
  async localize(picture) {
    const size = fitted(picture.width, picture.height, PHOTO_SIDE);
    this.viewer.show(picture, size, null);
    const reply = await this.api.localize(await new Encoder().jpeg(picture, size), this.chosen, false);
    if (reply.found) await this.fetchObject(reply.map);
    const object = reply.found ? this.objects.get(reply.map) : undefined;
    const state = nextState("searching", reply);
    if (object) {
      const [pose, camera] = [poseFrom(reply.cam_from_world), cameraFrom(reply.camera)];
      this.viewer.show(picture, size, { object, pose, camera, sure: state === "found" });
    }
    this.tell(reply, state);
  }

  /** @param {any} reply @param {string} state */
  tell(reply, state) {
    const sure = reply.confidence === null ? "" : ` · ${Math.round(100 * (reply.confidence ?? 0))} %`;
    const title = reply.found ? `${state === "found" ? "" : "Unsure: "}${reply.map}${sure}` : "Not found";
    this.panel.say(reply.found ? state : "lost", title, reply.found ? "" : (reply.reason ?? ""));
    this.panel.figure(`${Math.round(reply.ms?.total ?? 0)} ms`);
  }
}

/** @param {Page} page */
function listen(page) {
  element("start").addEventListener("click", () => page.startCamera());
  element("film").addEventListener("click", () => page.playFilm());
  element("stop").addEventListener("click", () => {
    page.stop();
    page.panel.say("idle", "Stopped", "Start the camera, or drop a photo or a video here.");
  });
  element("file").addEventListener("change", (/** @type {any} */ event) => {
    page.open(event.target.files[0]);
    event.target.value = "";
  });
  element("camera").addEventListener("change", (/** @type {any} */ event) => {
    page.deviceId = event.target.value;
    page.startCamera();
  });
  element("map").addEventListener("change", () => page.greet());
  for (const what of /** @type {("box" | "points" | "model")[]} */ (["box", "points", "model"])) {
    element(`show-${what}`).addEventListener("change", (/** @type {any} */ event) => {
      page.viewer.shown[what] = event.target.checked;
      page.viewer.repaint();
    });
  }
  listenToWindow(page);
}

/** Dropped files, and a page that is hidden: its camera stops, and starts again with it. @param {Page} page */
function listenToWindow(page) {
  addEventListener("dragover", (event) => event.preventDefault());
  addEventListener("drop", (event) => {
    event.preventDefault();
    page.open(event.dataTransfer?.files[0]);
  });
  document.addEventListener("visibilitychange", () => {
    const plays = page.live.runs && element("video").srcObject !== null;
    if (document.hidden && plays) {
      page.resumes = true;
      page.stop();
    } else if (!document.hidden && page.resumes) {
      page.resumes = false;
      page.startCamera();
    }
  });
}

async function main() {
  try {
    const page = new Page();
    listen(page);
    await page.load();
  } catch (error) {
    new Panel().say("failed", "Not ready", /** @type {Error} */ (error).message);
  }
}

main();
