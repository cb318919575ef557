/** The picture between two views: each bent by its depth into the wanted pose, then mixed (WebGL 2). */

import { relativePose } from "./geometry";
import type { Manifest, Pose } from "./manifest";
import { BLEND_SHADER, FULL_SHADER, MESH_FRAGMENT_SHADER, MESH_VERTEX_SHADER } from "./shaders";

export interface Source {
  picture: ImageBitmap;
  map: ImageBitmap | undefined;
  pose: Pose;
}

export interface Renderer {
  /** Draw one view, or between two the picture of `pose`, as carefully as a level of `Pace`; whether it bent. */
  draw(a: Source, b: Source | null, weight: number, pose: Pose, level: number): boolean;
}

/** Cross-fade without depth, where there is no WebGL 2. */
export class FadeRenderer implements Renderer {
  private readonly context: CanvasRenderingContext2D;

  constructor(private readonly canvas: HTMLCanvasElement) {
    this.context = canvas.getContext("2d", { alpha: false })!;
  }

  draw(a: Source, b: Source | null, weight: number): boolean {
    const { width, height } = this.canvas;
    this.context.globalAlpha = 1;
    this.context.drawImage(a.picture, 0, 0, width, height);
    if (b) {
      this.context.globalAlpha = weight;
      this.context.drawImage(b.picture, 0, 0, width, height);
    }
    return false;
  }
}

interface Target {
  texture: WebGLTexture;
  frame: WebGLFramebuffer;
  size: [number, number];
}

// Of each level that bends: map pixels per corner of the mesh, and what the picture's sides are divided by.
const STRIDES = [1, 3];
const REDUCTIONS = [1, 2];

export class WarpRenderer implements Renderer {
  private readonly mesh: WebGLProgram;
  private readonly blend: WebGLProgram;
  private readonly targets: Target[][];
  private readonly textures: {
    picture: WebGLTexture;
    map: WebGLTexture;
    shown: (ImageBitmap | undefined)[];
  }[];
  private grid = [0, 0];
  private meshes: { indices: WebGLBuffer; count: number }[] = [];

  constructor(
    private readonly gl: WebGL2RenderingContext,
    private readonly manifest: Manifest,
  ) {
    this.mesh = link(gl, MESH_VERTEX_SHADER, MESH_FRAGMENT_SHADER);
    this.blend = link(gl, FULL_SHADER, BLEND_SHADER);
    gl.bindVertexArray(gl.createVertexArray());
    this.targets = REDUCTIONS.map((by) => [0, 1].map(() => makeTarget(gl, manifest.size, by)));
    this.textures = [0, 1].map(() => ({
      picture: makeTexture(gl, gl.LINEAR),
      map: makeTexture(gl, gl.NEAREST),
      shown: [],
    }));
  }

  draw(a: Source, b: Source | null, weight: number, pose: Pose, level: number): boolean {
    const { gl } = this;
    this.upload(0, a);
    if (b) this.upload(1, b);
    const isBent = !!b && !!a.map && !!b.map && level < STRIDES.length;
    if (isBent) [a, b!].forEach((source, i) => this.bend(i, source, pose, level));
    const targets = this.targets[isBent ? level : 0]!;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.disable(gl.DEPTH_TEST);
    gl.useProgram(this.blend);
    const bound = [
      this.textures[0]!.picture,
      this.textures[1]!.picture,
      targets[0]!.texture,
      targets[1]!.texture,
    ];
    bound.forEach((texture, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    });
    ["first", "second", "bentFirst", "bentSecond"].forEach((name, unit) =>
      this.set1i(this.blend, name, unit),
    );
    gl.uniform1f(gl.getUniformLocation(this.blend, "weight"), b ? weight : 0);
    this.set1i(this.blend, "isBent", isBent ? 1 : 0);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    return isBent;
  }

  private set1i(program: WebGLProgram, name: string, value: number): void {
    this.gl.uniform1i(this.gl.getUniformLocation(program, name), value);
  }

  private upload(slot: number, source: Source): void {
    const { gl } = this;
    const { picture, map, shown } = this.textures[slot]!;
    gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, false);
    gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
    [
      [picture, source.picture],
      [map, source.map],
    ].forEach(([texture, bitmap], i) => {
      if (!bitmap || shown[i] === bitmap) return;
      gl.activeTexture(gl.TEXTURE0);
      gl.bindTexture(gl.TEXTURE_2D, texture as WebGLTexture);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, bitmap as ImageBitmap);
      shown[i] = bitmap as ImageBitmap;
    });
    if (!source.map || (this.grid[0] === source.map.width && this.grid[1] === source.map.height)) return;
    this.grid = [source.map.width, source.map.height];
    this.meshes = STRIDES.map((stride) => this.makeMesh(source.map!.width, source.map!.height, stride));
  }

  /** One source as a mesh with a corner per pixel of its map (or fewer), seen from `pose`. */
  private bend(slot: number, source: Source, pose: Pose, level: number): void {
    const { gl, mesh } = this;
    const target = this.targets[level]![slot]!;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
    gl.viewport(0, 0, ...target.size);
    gl.enable(gl.DEPTH_TEST);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.useProgram(mesh);
    const { picture, map } = this.textures[slot]!;
    [picture, map].forEach((texture, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    });
    this.set1i(mesh, "picture", 0);
    this.set1i(mesh, "map", 1);
    const { R, t } = relativePose(source.pose, pose);
    const at = (name: string): WebGLUniformLocation | null => gl.getUniformLocation(mesh, name);
    gl.uniform2i(at("grid"), this.grid[0]!, this.grid[1]!);
    gl.uniform2f(at("size"), ...this.manifest.size);
    gl.uniform4fv(at("source"), source.pose.intrinsics);
    gl.uniform4fv(at("target"), pose.intrinsics);
    gl.uniformMatrix3fv(at("rotation"), true, R);
    gl.uniform3fv(at("shift"), t);
    gl.uniform1f(at("nearest"), this.manifest.inverse_depth_max);
    const { indices, count } = this.meshes[level]!;
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, indices);
    gl.drawElements(gl.TRIANGLES, count, gl.UNSIGNED_INT, 0);
  }

  private makeMesh(width: number, height: number, stride: number): { indices: WebGLBuffer; count: number } {
    const { gl } = this;
    const cells = meshIndices(width, height, stride);
    const indices = gl.createBuffer()!;
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, indices);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, cells, gl.STATIC_DRAW);
    return { indices, count: cells.length };
  }
}

/** Corners of the triangles that cover a grid, every stride-th cell and always the last. */
export function meshIndices(width: number, height: number, stride: number): Uint32Array<ArrayBuffer> {
  const places = (count: number): number[] => {
    const all = Array.from({ length: Math.ceil((count - 1) / stride) }, (_, i) => i * stride);
    return [...all, count - 1];
  };
  const [columns, rows] = [places(width), places(height)];
  const indices: number[] = [];
  for (let j = 0; j + 1 < rows.length; j++)
    for (let i = 0; i + 1 < columns.length; i++) {
      const [a, b] = [rows[j]! * width + columns[i]!, rows[j]! * width + columns[i + 1]!];
      const [c, d] = [rows[j + 1]! * width + columns[i]!, rows[j + 1]! * width + columns[i + 1]!];
      indices.push(a, b, c, b, d, c);
    }
  return new Uint32Array(indices);
}

function makeTarget(gl: WebGL2RenderingContext, full: [number, number], by: number): Target {
  const size: [number, number] = [Math.ceil(full[0] / by), Math.ceil(full[1] / by)];
  // At full size a pixel is read where it was drawn; its neighbours may be black, as nothing was drawn there.
  const texture = makeTexture(gl, by === 1 ? gl.NEAREST : gl.LINEAR);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA8, ...size);
  const depth = gl.createRenderbuffer();
  gl.bindRenderbuffer(gl.RENDERBUFFER, depth);
  gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, ...size);
  const frame = gl.createFramebuffer()!;
  gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
  gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, depth);
  return { texture, frame, size };
}

function link(gl: WebGL2RenderingContext, vertex: string, fragment: string): WebGLProgram {
  const program = gl.createProgram()!;
  for (const [kind, text] of [
    [gl.VERTEX_SHADER, vertex],
    [gl.FRAGMENT_SHADER, fragment],
  ] as const) {
    const shader = gl.createShader(kind)!;
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS))
    throw new Error(`shader: ${gl.getProgramInfoLog(program) ?? "unknown error"}`);
  return program;
}

function makeTexture(gl: WebGL2RenderingContext, filter: number): WebGLTexture {
  const texture = gl.createTexture()!;
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, filter);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, filter);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  return texture;
}

/** The best that the browser can do. */
export function makeRenderer(canvas: HTMLCanvasElement, manifest: Manifest): Renderer {
  const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, preserveDrawingBuffer: true });
  return gl ? new WarpRenderer(gl, manifest) : new FadeRenderer(canvas);
}
