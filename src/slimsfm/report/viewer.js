"use strict";
// Draws a map in 3D on a plain canvas: points through a depth buffer, then images and box as lines.
// The frame: origin at the box's center, z up, unit the box's diagonal.
// A map is decoded when its section is opened.

const FOCAL = 1.3;   // relative to the canvas's shorter side
const NEAR = 0.02;
const FEW = 3000;    // this many points or fewer are drawn larger

function decode(text, Type) {
  const bytes = Uint8Array.from(atob(text), letter => letter.charCodeAt(0));
  return new Type(bytes.buffer);
}

// Axes and position of the eye.
function eye(state) {
  const cy = Math.cos(state.yaw), sy = Math.sin(state.yaw);
  const cp = Math.cos(state.pitch), sp = Math.sin(state.pitch);
  return {
    right: [-sy, cy, 0], down: [cy * sp, sy * sp, -cp], back: [cy * cp, sy * cp, sp],
    distance: state.distance, shift: state.shift,
  };
}

function drawPoints(context, width, height, view, focal, map, dot) {
  const picture = context.createImageData(width, height);
  const colors = new Uint32Array(picture.data.buffer), depths = new Float32Array(width * height).fill(Infinity);
  const { right: r, down: d, back: b } = view, p = map.points, c = map.colors;
  const least = (p.length < 3 * FEW ? 3.5 : 1.5) * dot, most = 2 * least + 2 * dot;
  for (let i = 0; i < p.length; i += 3) {
    const x = p[i], y = p[i + 1], z = p[i + 2];
    const depth = view.distance - (b[0] * x + b[1] * y + b[2] * z);
    if (depth < NEAR) continue;
    const u = width / 2 + focal * ((r[0] * x + r[1] * y + r[2] * z) / depth - view.shift[0]);
    const v = height / 2 + focal * ((d[0] * x + d[1] * y + d[2] * z) / depth - view.shift[1]);
    if (!(u > -9 && v > -9 && u < width + 9 && v < height + 9)) continue;
    const size = Math.round(Math.min(most, Math.max(least, 0.006 * focal / depth)));
    const color = 0xff000000 | c[i + 2] << 16 | c[i + 1] << 8 | c[i];
    const left = Math.round(u - size / 2), top = Math.round(v - size / 2);
    for (let row = Math.max(0, top); row < Math.min(height, top + size); row++) {
      for (let column = Math.max(0, left); column < Math.min(width, left + size); column++) {
        const k = row * width + column;
        if (depth < depths[k]) { depths[k] = depth; colors[k] = color; }
      }
    }
  }
  context.putImageData(picture, 0, 0);
}

// Adds a line to the current path, clipped in front of the eye.
function line(context, width, height, view, focal, from, to) {
  const seen = [from, to].map(point => {
    const dot = axis => axis[0] * point[0] + axis[1] * point[1] + axis[2] * point[2];
    return [dot(view.right), dot(view.down), view.distance - dot(view.back)];
  });
  if (seen[0][2] < NEAR && seen[1][2] < NEAR) return;
  for (const [own, other] of [[0, 1], [1, 0]]) {
    if (seen[own][2] >= NEAR) continue;
    const share = (NEAR - seen[own][2]) / (seen[other][2] - seen[own][2]);
    seen[own] = seen[own].map((value, k) => value + share * (seen[other][k] - value));
  }
  const [right, down] = view.shift;
  const place = ([x, y, z]) => [width / 2 + focal * (x / z - right), height / 2 + focal * (y / z - down)];
  context.moveTo(...place(seen[0]));
  context.lineTo(...place(seen[1]));
}

// Distance and shift of the eye with which the box and all images fill the picture.
function fit(canvas, scene, state) {
  const { right, down, back } = eye(state), focal = FOCAL * Math.min(canvas.clientWidth, canvas.clientHeight);
  const dot = (axis, point) => axis[0] * point[0] + axis[1] * point[1] + axis[2] * point[2];
  const points = [...scene.box, ...scene.images.flat()];
  const extent = (axis, distance) => {
    const places = points.map(point => dot(axis, point) / (distance - dot(back, point)));
    return [Math.min(...places), Math.max(...places)];
  };
  const fits = (axis, distance, side) => {
    const [low, high] = extent(axis, distance);
    return focal * (high - low) < 0.94 * side;
  };
  let near = NEAR + Math.max(...points.map(point => dot(back, point))), far = 200;
  for (let step = 0; step < 30; step++) {
    const middle = (near + far) / 2;
    if (fits(right, middle, canvas.clientWidth) && fits(down, middle, canvas.clientHeight)) far = middle;
    else near = middle;
  }
  const middle = axis => extent(axis, far).reduce((low, high) => (low + high) / 2);
  return { distance: far, shift: [middle(right), middle(down)] };
}

function draw(canvas, scene, state) {
  const dot = Math.min(window.devicePixelRatio || 1, 2);
  const width = Math.max(1, Math.round(canvas.clientWidth * dot));
  const height = Math.max(1, Math.round(canvas.clientHeight * dot));
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  const context = canvas.getContext("2d"), style = getComputedStyle(canvas);
  const view = eye(state), focal = FOCAL * Math.min(width, height), map = scene.maps[state.show];
  drawPoints(context, width, height, view, focal, map, dot);
  const lines = (color, thickness, alpha, pairs) => {
    context.beginPath();
    for (const [from, to] of pairs) line(context, width, height, view, focal, from, to);
    context.strokeStyle = style.getPropertyValue(color);
    context.lineWidth = thickness * dot;
    context.globalAlpha = alpha;
    context.stroke();
    context.globalAlpha = 1;
  };
  const frusta = images => images.map(k => scene.images[k]).flatMap(
    ([o, a, b, c, d]) => [[o, a], [o, b], [o, c], [o, d], [a, b], [b, c], [c, d], [d, a]]);
  lines("--box", 1.5, 0.9, scene.edges.map(([i, j]) => [scene.box[i], scene.box[j]]));
  lines("--dropped", 1, 0.7, frusta(map.images.filter(k => !scene.chosen[k])));
  lines("--chosen", 1.8, 1, frusta(map.images.filter(k => scene.chosen[k])));
  if (state.lit !== null) lines("--ink", 3.5, 1, frusta([state.lit]));
}

// Dragging turns, two fingers or the wheel zoom; so do arrow keys, + and -.
function listen(canvas, state, reset, redraw) {
  const fingers = new Map();
  const pinch = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a.x - b.x, a.y - b.y); };
  const turn = (yaw, pitch) => {
    state.moved = true;
    state.yaw += yaw;
    state.pitch = Math.max(-1.55, Math.min(1.55, state.pitch + pitch));
    redraw();
  };
  const zoom = factor => {
    state.moved = true;
    state.distance = Math.max(0.2, Math.min(200, state.distance * factor));
    redraw();
  };
  canvas.addEventListener("pointerdown", event => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", event => {
    const last = fingers.get(event.pointerId);
    if (!last) return;
    const before = fingers.size === 2 ? pinch() : 0;
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (fingers.size === 2) zoom(before / Math.max(1, pinch()));
    else turn((last.x - event.clientX) / 150, (event.clientY - last.y) / 150);
  });
  for (const end of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(end, event => fingers.delete(event.pointerId));
  }
  canvas.addEventListener("wheel", event => {
    event.preventDefault();
    zoom(Math.exp(Math.max(-100, Math.min(100, event.deltaY)) / 500));
  }, { passive: false });
  canvas.addEventListener("dblclick", () => { reset(); redraw(); });
  const keys = {
    ArrowLeft: () => turn(-0.1, 0), ArrowRight: () => turn(0.1, 0), ArrowUp: () => turn(0, 0.1),
    ArrowDown: () => turn(0, -0.1), "+": () => zoom(0.9), "-": () => zoom(1 / 0.9),
  };
  canvas.addEventListener("keydown", event => {
    if (!(event.key in keys)) return;
    event.preventDefault();
    keys[event.key]();
  });
}

function start(place) {
  const canvas = place.querySelector("canvas"), buttons = [...place.querySelectorAll("[data-show]")];
  const scene = JSON.parse(place.querySelector("script").textContent);
  for (const map of Object.values(scene.maps)) {
    map.points = decode(map.points, Float32Array);
    map.colors = decode(map.colors, Uint8Array);
  }
  const state = { show: buttons[0].dataset.show, lit: null };
  const reset = () => {
    Object.assign(state, { yaw: 0.5, pitch: 0.4, moved: false });
    Object.assign(state, fit(canvas, scene, state));
  };
  let waiting = false;
  const redraw = () => {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; draw(canvas, scene, state); });
  };
  listen(canvas, state, reset, redraw);
  for (const button of buttons) {
    button.addEventListener("click", () => {
      state.show = button.dataset.show;
      buttons.forEach(other => other.setAttribute("aria-pressed", String(other === button)));
      redraw();
    });
  }
  place.parentElement.addEventListener("image", event => { state.lit = event.detail; redraw(); });
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  return { resized: () => { if (!state.moved) reset(); redraw(); } };
}

for (const place of document.querySelectorAll(".view")) {
  let view = null;
  new ResizeObserver(([entry]) => {
    if (!entry.contentRect.width) return;
    view ??= start(place);
    view.resized();
  }).observe(place.querySelector("canvas"));
}
