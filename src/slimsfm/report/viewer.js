"use strict";
// Draws a map in 3D on a plain canvas: points through a depth buffer, then images and box as lines.
// The frame: origin in the box's centre, z up, unit the box's diagonal.

const FOCAL = 1.3;   // over the canvas's shorter side
const NEAR = 0.02;

function decode(text, Type) {
  const bytes = Uint8Array.from(atob(text), letter => letter.charCodeAt(0));
  return new Type(bytes.buffer);
}

// Where the eye is, as a function that gives right, down and depth of a point.
function eye(state) {
  const cy = Math.cos(state.yaw), sy = Math.sin(state.yaw);
  const cp = Math.cos(state.pitch), sp = Math.sin(state.pitch);
  return {
    right: [-sy, cy, 0], down: [cy * sp, sy * sp, -cp], back: [cy * cp, sy * cp, sp], distance: state.distance,
  };
}

function drawPoints(context, width, height, view, focal, map, dot) {
  const picture = context.createImageData(width, height);
  const colors = new Uint32Array(picture.data.buffer), depths = new Float32Array(width * height).fill(Infinity);
  const { right: r, down: d, back: b } = view, p = map.points, c = map.colors;
  for (let i = 0; i < p.length; i += 3) {
    const x = p[i], y = p[i + 1], z = p[i + 2];
    const depth = view.distance - (b[0] * x + b[1] * y + b[2] * z);
    if (depth < NEAR) continue;
    const u = width / 2 + focal * (r[0] * x + r[1] * y + r[2] * z) / depth;
    const v = height / 2 + focal * (d[0] * x + d[1] * y + d[2] * z) / depth;
    if (!(u > -9 && v > -9 && u < width + 9 && v < height + 9)) continue;
    const size = Math.round(Math.min(5 * dot, Math.max(1.5 * dot, 0.006 * focal / depth)));
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

// Adds a line to the current path, cut where it passes behind the eye.
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
  const place = ([x, y, z]) => [width / 2 + focal * x / z, height / 2 + focal * y / z];
  context.moveTo(...place(seen[0]));
  context.lineTo(...place(seen[1]));
}

// The distance from which the box and all images of both maps are in the picture.
function fit(canvas, scene, state) {
  const { right, down, back } = eye(state), focal = FOCAL * Math.min(canvas.clientWidth, canvas.clientHeight);
  const dot = (axis, point) => axis[0] * point[0] + axis[1] * point[1] + axis[2] * point[2];
  let distance = 0.2;
  for (const point of [...scene.box, ...scene.before.images.flat(), ...scene.after.images.flat()]) {
    const across = Math.abs(dot(right, point)) / canvas.clientWidth;
    const along = Math.abs(dot(down, point)) / canvas.clientHeight;
    distance = Math.max(distance, dot(back, point) + focal * Math.max(across, along) / 0.48);
  }
  return distance;
}

function draw(canvas, scene, state) {
  const dot = Math.min(window.devicePixelRatio || 1, 2);
  const width = Math.max(1, Math.round(canvas.clientWidth * dot));
  const height = Math.max(1, Math.round(canvas.clientHeight * dot));
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  const context = canvas.getContext("2d"), style = getComputedStyle(canvas);
  const view = eye(state), focal = FOCAL * Math.min(width, height), map = scene[state.show];
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
  const frusta = wanted => map.images.filter((_, k) => map.chosen[k] === wanted).flatMap(
    ([o, a, b, c, d]) => [[o, a], [o, b], [o, c], [o, d], [a, b], [b, c], [c, d], [d, a]]);
  lines("--box", 1.5, 0.9, scene.edges.map(([i, j]) => [scene.box[i], scene.box[j]]));
  lines("--dropped", 1, 0.7, frusta(0));
  lines("--chosen", 1.8, 1, frusta(1));
}

// Drag turns, two fingers or the wheel zoom, arrow keys and + - do the same.
function listen(canvas, state, reset, redraw) {
  const fingers = new Map();
  const spread = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a.x - b.x, a.y - b.y); };
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
    const before = fingers.size === 2 ? spread() : 0;
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (fingers.size === 2) zoom(before / Math.max(1, spread()));
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

for (const place of document.querySelectorAll(".view")) {
  const canvas = place.querySelector("canvas"), buttons = place.querySelectorAll("[data-show]");
  const scene = JSON.parse(place.querySelector("script").textContent);
  for (const map of [scene.before, scene.after]) {
    map.points = decode(map.points, Float32Array);
    map.colors = decode(map.colors, Uint8Array);
  }
  const state = { show: "before" };
  const reset = () => {
    Object.assign(state, { yaw: 0.5, pitch: 0.4, moved: false });
    state.distance = fit(canvas, scene, state);
  };
  let waiting = false;
  const redraw = () => {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; draw(canvas, scene, state); });
  };
  reset();
  listen(canvas, state, reset, redraw);
  for (const button of buttons) {
    button.addEventListener("click", () => {
      state.show = button.dataset.show;
      buttons.forEach(other => other.setAttribute("aria-pressed", String(other === button)));
      redraw();
    });
  }
  new ResizeObserver(() => { if (!state.moved) reset(); redraw(); }).observe(canvas);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
}
