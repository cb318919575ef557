/** Drawing a mark on the picture of a real camera. */

import type { App } from "./app";
import { type Mark, type Point, boxOf, exportMark, isComplete } from "./mark";
import { element, save } from "./page";
import { clamp } from "./state";

const EDGES = ["mark-left", "mark-top", "mark-right", "mark-bottom"];

export function connectMark(app: App): void {
  const stage = element("stage");
  const layer = element<SVGSVGElement>("mark");
  const saveMark = element<HTMLButtonElement>("save-mark");
  const compare = element<HTMLInputElement>("compare");
  const edges = EDGES.map((name) => element<HTMLInputElement>(name));
  const buttons = { box: element("draw-box"), polygon: element("draw-polygon") };
  let shape: Mark["shape"] | null = null;
  let mark: Mark = { shape: "box", points: [] };
  let isDragging = false;

  const show = (): void => {
    layer.toggleAttribute("hidden", shape === null && !mark.points.length);
    layer.replaceChildren(drawShape(mark));
    saveMark.disabled = !isComplete(mark);
    stage.classList.toggle("drawing", shape !== null);
    for (const [name, button] of Object.entries(buttons))
      button.setAttribute("aria-pressed", String(shape === name));
    if (mark.shape === "box" && mark.points.length === 2)
      boxOf(mark.points).forEach(
        (value, i) => (edges[i]!.value = (100 * toPicture(app, [value, value])[i % 2]!).toFixed(1)),
      );
  };
  const begin = (next: Mark["shape"]): void => {
    shape = shape === next ? null : next;
    if (shape) {
      // The mark belongs to one moment of one camera: neither moves while it is drawn.
      mark = { shape, points: [] };
      app.change((state) => ({ ...state, isPlaying: false }));
      app.pinnedCamera = app.camera;
      if (!compare.checked) compare.click();
    } else app.pinnedCamera = mark.points.length ? app.pinnedCamera : null;
    app.invalidate();
    show();
  };
  const at = (event: PointerEvent): Point => {
    const size = stage.getBoundingClientRect();
    return inPicture(app, [
      (event.clientX - size.left) / size.width,
      (event.clientY - size.top) / size.height,
    ]);
  };
  buttons.box.addEventListener("click", () => begin("box"));
  buttons.polygon.addEventListener("click", () => begin("polygon"));
  element("clear-mark").addEventListener("click", () => {
    mark = { shape: "box", points: [] };
    shape = null;
    app.pinnedCamera = null;
    edges.forEach((edge) => (edge.value = ""));
    app.invalidate();
    show();
  });
  stage.addEventListener(
    "pointerdown",
    (event) => {
      if (!shape || event.button !== 0) return;
      event.stopImmediatePropagation();
      isDragging = shape === "box";
      mark = { shape, points: isDragging ? [at(event), at(event)] : [...mark.points, at(event)] };
      show();
    },
    { capture: true },
  );
  stage.addEventListener(
    "pointermove",
    (event) => {
      if (!shape) return;
      event.stopImmediatePropagation();
      if (!isDragging) return;
      mark = { shape, points: [mark.points[0]!, at(event)] };
      show();
    },
    { capture: true },
  );
  stage.addEventListener("pointerup", () => (isDragging = false), { capture: true });
  edges.forEach((edge) =>
    edge.addEventListener("change", () => {
      if (edges.some((other) => other.value === "")) return;
      if (app.pinnedCamera === null) begin("box");
      const [left, top, right, bottom] = edges.map((other) => clamp(Number(other.value) / 100, 0, 1)) as [
        number,
        number,
        number,
        number,
      ];
      mark = { shape: "box", points: [fromPicture(app, [left, top]), fromPicture(app, [right, bottom])] };
      show();
    }),
  );
  saveMark.addEventListener("click", () => {
    const camera = app.manifest.cameras[app.camera]!;
    const own: Mark = { ...mark, points: mark.points.map((point) => toPicture(app, point)) };
    const { scene } = app.manifest;
    const operation = element<HTMLSelectElement>("operation").value;
    save(
      `${scene}_${operation}.yaml`,
      exportMark(own, scene, operation, camera.name, app.frame, camera.size),
    );
  });
  show();
}

function drawShape(mark: Mark): SVGElement {
  const isOpen = mark.shape === "polygon" && mark.points.length < 3;
  const shape = document.createElementNS("http://www.w3.org/2000/svg", isOpen ? "polyline" : "polygon");
  let points = mark.points;
  if (mark.shape === "box" && points.length === 2) {
    const [left, top, right, bottom] = boxOf(points);
    points = [
      [left, top],
      [right, top],
      [right, bottom],
      [left, bottom],
    ];
  }
  shape.setAttribute("points", points.map((point) => point.join(",")).join(" "));
  return shape;
}

/** Left, top, width and height, in shares of the stage, of a camera's picture that is fitted into it. */
function pictureArea(app: App): [number, number, number, number] {
  const [width, height] = app.manifest.size;
  const [ownWidth, ownHeight] = app.manifest.cameras[app.camera]!.picture;
  const aspect = ownWidth / ownHeight / (width / height);
  const [w, h] = [Math.min(1, aspect), Math.min(1, 1 / aspect)];
  return [(1 - w) / 2, (1 - h) / 2, w, h];
}

/** A point of the stage, moved into the picture. */
function inPicture(app: App, point: Point): Point {
  const [left, top, width, height] = pictureArea(app);
  return [clamp(point[0], left, left + width), clamp(point[1], top, top + height)];
}

function toPicture(app: App, point: Point): Point {
  const [left, top, width, height] = pictureArea(app);
  return [(point[0] - left) / width, (point[1] - top) / height];
}

function fromPicture(app: App, point: Point): Point {
  const [left, top, width, height] = pictureArea(app);
  return [left + point[0] * width, top + point[1] * height];
}
