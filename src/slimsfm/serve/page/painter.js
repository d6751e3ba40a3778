/** A small WebGL2 painter: a picture, and over it lines, points and a lit, textured mesh. */
import { projectionMatrix, viewMatrix } from "./matrices.js";
import { LINES, MESH, PICTURE, POINTS } from "./shaders.js";

/**
 * @typedef {import("./pose.js").Pose} Pose @typedef {import("./pose.js").Camera} Camera
 * @typedef {{x: number, y: number, width: number, height: number}} Rectangle Pixels of the canvas, y up.
 * @typedef {{array: WebGLVertexArrayObject, count: number, indexed: boolean}} Shape Data on the GPU.
 * @typedef {{pose: Pose, camera: Camera, near: number, far: number}} Eye
 * @typedef {[number, number, number]} Rgb From 0 to 1.
 */

const PLACES = { corner: 0, from: 1, to: 2, tint: 3, normal: 4, texel: 5 };
const QUAD = new Float32Array([0, 0, 1, 0, 0, 1, 1, 1]);
const ENDS = new Float32Array([0, -1, 0, 1, 1, -1, 1, 1]);

/** @param {WebGL2RenderingContext} gl @param {number} kind @param {string} text */
function compiled(gl, kind, text) {
  const shader = /** @type {WebGLShader} */ (gl.createShader(kind));
  gl.shaderSource(shader, text);
  gl.compileShader(shader);
  if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader) ?? "shader");
  return shader;
}

/** A linked program and the places of its uniforms. @param {WebGL2RenderingContext} gl @param {{vertex: string, fragment: string}} source */
function linked(gl, source) {
  const program = gl.createProgram();
  gl.attachShader(program, compiled(gl, gl.VERTEX_SHADER, source.vertex));
  gl.attachShader(program, compiled(gl, gl.FRAGMENT_SHADER, source.fragment));
  for (const [name, place] of Object.entries(PLACES)) gl.bindAttribLocation(program, place, name);
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program) ?? "program");
  const uniforms = new Map();
  for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
    const { name } = /** @type {WebGLActiveInfo} */ (gl.getActiveUniform(program, i));
    uniforms.set(name, gl.getUniformLocation(program, name));
  }
  return { program, uniforms };
}

/** Draws on one canvas. */
export class Painter {
  /** @param {HTMLCanvasElement} canvas @throws {Error} The browser has no WebGL2. */
  constructor(canvas) {
    // lines and points have soft edges of their own; without a GPU, antialiasing takes more time than all else
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("This browser has no WebGL2, which the page draws with.");
    this.canvas = canvas;
    this.gl = gl;
    this.programs = {
      picture: linked(gl, PICTURE), lines: linked(gl, LINES), points: linked(gl, POINTS), mesh: linked(gl, MESH),
    };
    this.quad = this.shape({ corner: { data: QUAD, size: 2 } }, 4);
    this.picture = this.texture();
    /** @type {WebGLSync | null} */
    this.fence = null;
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }

  /**
   * Data for drawing.
   *
   * @param {Partial<Record<keyof typeof PLACES, {data: Float32Array, size: number, perInstance?: boolean, stride?: number, offset?: number}>>} attributes
   * @param {number} count Vertices, instances or indices.
   * @param {Uint32Array | null} [indices]
   * @returns {Shape}
   */
  shape(attributes, count, indices = null) {
    const { gl } = this;
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    for (const [name, { data, size, perInstance, stride, offset }] of Object.entries(attributes)) {
      const place = PLACES[/** @type {keyof typeof PLACES} */ (name)];
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, size, gl.FLOAT, false, 4 * (stride ?? 0), 4 * (offset ?? 0));
      gl.vertexAttribDivisor(place, perInstance ? 1 : 0);
    }
    if (indices) {
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
    }
    gl.bindVertexArray(null);
    return { array, count, indexed: indices !== null };
  }

  /** Segments from point to point, each of a color. @param {number[][][]} segments Pairs of points. @param {Rgb[]} tints */
  lines(segments, tints) {
    const ends = new Float32Array(segments.flat(2));
    const from = { data: ends, size: 3, perInstance: true, stride: 6, offset: 0 };
    const tint = { data: new Float32Array(tints.flat()), size: 3, perInstance: true };
    return this.shape({ corner: { data: ENDS, size: 2 }, from, to: { ...from, offset: 3 }, tint }, segments.length);
  }

  /** An image on the GPU. @param {boolean} [repeats] Also shrunk, for meshes. */
  texture(repeats = false) {
    const { gl } = this;
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    const edge = repeats ? gl.REPEAT : gl.CLAMP_TO_EDGE;
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, edge);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, edge);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, repeats ? gl.LINEAR_MIPMAP_LINEAR : gl.LINEAR);
    return texture;
  }

  /** @param {WebGLTexture} texture @param {TexImageSource} source @param {{flipped?: boolean, shrunk?: boolean}} [how] */
  fill(texture, source, { flipped = false, shrunk = false } = {}) {
    const { gl } = this;
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.pixelStorei(gl.UNPACK_FLIP_Y_WEBGL, flipped);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, source);
    gl.pixelStorei(gl.UNPACK_FLIP_Y_WEBGL, false);
    if (shrunk) gl.generateMipmap(gl.TEXTURE_2D);
  }

  /** Remember the work until now, see `busy`. */
  mark() {
    const { gl } = this;
    if (this.fence) gl.deleteSync(this.fence);
    this.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
  }

  /** Whether the GPU still works on what was marked: more work would only queue up behind it. */
  get busy() {
    const { gl, fence } = this;
    return Boolean(fence) && gl.getSyncParameter(/** @type {WebGLSync} */ (fence), gl.SYNC_STATUS) !== gl.SIGNALED;
  }

  /** Show a picture in a part of the canvas; the rest is black. @param {TexImageSource} source @param {Rectangle} part */
  show(source, part) {
    this.fill(this.picture, source);
    this.repaint(part);
  }

  /** Show the last picture again. @param {Rectangle} part */
  repaint(part) {
    const { gl } = this;
    gl.clearColor(0.04, 0.045, 0.05, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    this.within(part);
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    gl.useProgram(this.programs.picture.program);
    gl.bindTexture(gl.TEXTURE_2D, this.picture);
    gl.bindVertexArray(this.quad.array);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }

  /** Draw in a part of the canvas from now on. @param {Rectangle} part */
  within(part) {
    this.part = part;
    this.gl.viewport(part.x, part.y, part.width, part.height);
  }

  /** Fill a part of the canvas, and draw there from now on. @param {Rectangle} part @param {Rgb} color */
  blank(part, color) {
    const { gl } = this;
    this.within(part);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(part.x, part.y, part.width, part.height);
    gl.clearColor(...color, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.disable(gl.SCISSOR_TEST);
  }

  /** @param {Shape} shape @param {Eye} eye @param {{width: number, opacity?: number, paint?: Rgb, deep?: boolean}} style Width in pixels; one color for all; whether the mesh hides lines. */
  drawLines(shape, eye, { width, opacity = 1, paint, deep = false }) {
    const { gl } = this;
    const { uniforms } = this.begin("lines", eye, { blend: true, deep });
    gl.uniform2f(uniforms.get("size"), this.part.width, this.part.height);
    gl.uniform1f(uniforms.get("width"), width);
    gl.uniform1f(uniforms.get("near"), eye.near);
    gl.uniform1f(uniforms.get("opacity"), opacity);
    gl.uniform4f(uniforms.get("paint"), ...(paint ?? [0, 0, 0]), paint ? 1 : 0);
    gl.bindVertexArray(shape.array);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, shape.count);
  }

  /** @param {Shape} shape @param {Eye} eye @param {{width: number, opacity?: number, core?: number}} style Width in pixels; share of it within the dark rim. */
  drawPoints(shape, eye, { width, opacity = 1, core = 0.72 }) {
    const { gl } = this;
    const { uniforms } = this.begin("points", eye, { blend: true, deep: false });
    gl.uniform1f(uniforms.get("width"), width);
    gl.uniform1f(uniforms.get("opacity"), opacity);
    gl.uniform1f(uniforms.get("core"), core);
    gl.bindVertexArray(shape.array);
    gl.drawArrays(gl.POINTS, 0, shape.count);
  }

  /** @param {Shape} shape @param {Eye} eye @param {WebGLTexture | null} texture */
  drawMesh(shape, eye, texture) {
    const { gl } = this;
    const { uniforms } = this.begin("mesh", eye, { blend: false, deep: true });
    gl.bindTexture(gl.TEXTURE_2D, texture ?? this.picture);
    gl.uniform1i(uniforms.get("textured"), texture ? 1 : 0);
    gl.bindVertexArray(shape.array);
    gl.drawElements(gl.TRIANGLES, shape.count, gl.UNSIGNED_INT, 0);
  }

  /** @param {"lines" | "points" | "mesh"} name @param {Eye} eye @param {{blend: boolean, deep: boolean}} how */
  begin(name, eye, { blend, deep }) {
    const { gl } = this;
    const { program, uniforms } = this.programs[name];
    gl.useProgram(program);
    (blend ? gl.enable : gl.disable).call(gl, gl.BLEND);
    (deep ? gl.enable : gl.disable).call(gl, gl.DEPTH_TEST);
    gl.uniformMatrix4fv(uniforms.get("view"), false, viewMatrix(eye.pose));
    gl.uniformMatrix4fv(uniforms.get("projection"), false, projectionMatrix(eye.camera, eye.near, eye.far));
    gl.uniform4f(uniforms.get("distortion"), ...eye.camera.distortion);
    return { program, uniforms };
  }
}
