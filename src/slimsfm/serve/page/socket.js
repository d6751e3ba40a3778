/** The connection that frames go through: one frame in flight, again and again connected when it breaks. */
import { frameMessage, hello, parsed } from "./protocol.js";

const PATIENCE_MS = 8000; // for an answer
const PAUSES_MS = [300, 1000, 2000, 4000];
const FINAL = [4400, 4401, 4404]; // trying again would not help

/**
 * @typedef {Parameters<typeof hello>[0]} Hello
 * @typedef {{onPose: (reply: any) => void, onProblem: (text: string, isFinal: boolean) => void, onWelcome: () => void}} Events
 */

export class TrackSocket {
  /** @param {string} address @param {Events} events */
  constructor(address, events) {
    this.address = address;
    this.events = events;
    /** @type {WebSocket | null} */
    this.socket = null;
    /** @type {Hello | null} */
    this.hello = null;
    this.welcomed = false;
    this.inFlight = false;
    this.failures = 0;
    this.sequence = 0;
    this.timer = 0;
  }

  /** Whether a frame may be sent now. */
  get ready() {
    return this.welcomed && !this.inFlight;
  }

  /** Connect, or begin anew with other frames. @param {Hello} hello */
  begin(hello) {
    this.hello = hello;
    this.welcomed = false;
    if (this.socket?.readyState === WebSocket.OPEN) this.greet();
    else if (!this.socket) this.connect();
  }

  connect() {
    const socket = new WebSocket(this.address);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    socket.onopen = () => this.greet();
    socket.onmessage = ({ data }) => this.receive(parsed(data));
    socket.onclose = ({ code, reason }) => this.closed(socket, code, reason);
    this.expect();
  }

  greet() {
    if (this.hello) this.socket?.send(hello(this.hello));
    this.expect();
  }

  /** @param {any} message */
  receive(message) {
    clearTimeout(this.timer);
    if (message?.type === "welcome") {
      this.welcomed = true;
      this.inFlight = false;
      this.failures = 0;
      this.events.onWelcome();
    } else if (message?.type === "pose") {
      this.inFlight = false;
      this.events.onPose(message);
    } else if (message?.type === "error") {
      this.problem = message.error.message;
    }
  }

  /** @param {number} captured @param {ArrayBuffer} jpeg @returns {number} The number of the frame. */
  send(captured, jpeg) {
    this.sequence += 1;
    this.inFlight = true;
    this.socket?.send(frameMessage(this.sequence, captured, jpeg));
    this.expect();
    return this.sequence;
  }

  /** Give up if no answer comes. */
  expect() {
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.socket?.close(), PATIENCE_MS);
  }

  /** @param {WebSocket} socket @param {number} code @param {string} reason */
  closed(socket, code, reason) {
    if (socket !== this.socket) return;
    const isFinal = FINAL.includes(code);
    clearTimeout(this.timer);
    this.socket = null;
    this.welcomed = this.inFlight = false;
    this.events.onProblem(this.problem ?? (reason || "The connection broke; trying again."), isFinal);
    this.problem = undefined;
    if (isFinal) return;
    const pause = PAUSES_MS[Math.min(this.failures, PAUSES_MS.length - 1)];
    this.failures += 1;
    this.timer = setTimeout(() => this.hello && !this.socket && this.connect(), pause);
  }

  /** End the connection. */
  close() {
    const socket = this.socket;
    clearTimeout(this.timer);
    this.socket = null;
    this.hello = null;
    this.welcomed = this.inFlight = false;
    socket?.close(1000);
  }
}
