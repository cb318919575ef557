/** The tools beside the stage: map of the cameras, camera path. */

import type { App } from "./app";
import { centerOf, nearestView } from "./geometry";
import { momentOfFrame, poseAt } from "./manifest";
import { type MapView, drawMap } from "./map";
import { element, make, save } from "./page";
import { type Path, durationOf, exportPath, isOutside, pathAt, tidyPath } from "./path";
import { clamp, orbit } from "./state";

const TURN = 0.15;

export function connectMap(app: App): void {
  const canvas = element<HTMLCanvasElement>("map");
  const context = canvas.getContext("2d")!;
  const view: MapView = { azimuth: 0.25, elevation: 0.75, zoom: 1 };
  let places: [number, number][] = [];
  const style = getComputedStyle(document.documentElement);
  const colour = (name: string): string => style.getPropertyValue(`--${name}`).trim();
  const draw = (): void => {
    if (!canvas.offsetParent) return;
    const colours = {
      ink: colour("ink"),
      soft: colour("soft"),
      camera: colour("camera"),
      heldout: colour("heldout"),
      shown: colour("shown"),
      card: colour("card"),
    };
    places = drawMap(context, app.manifest, view, app.pose, app.moment, app.camera, colours);
  };
  const turn = (azimuth: number, elevation: number): void => {
    view.azimuth += azimuth;
    view.elevation = clamp(view.elevation + elevation, 0, Math.PI / 2);
    draw();
  };
  connectTurning(canvas, turn, (x, y) => {
    const at = places.findIndex((place) => Math.hypot(place[0] - x, place[1] - y) < 24);
    if (at >= 0) goToCamera(app, at);
  });
  canvas.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      view.zoom = clamp(view.zoom * Math.exp(-event.deltaY * 0.001), 0.4, 4);
      draw();
    },
    { passive: false },
  );
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  canvas.closest("details")!.addEventListener("toggle", draw);
  app.onState(draw);
  element("heldout-hint").hidden = !app.manifest.cameras.some((camera) => camera.is_heldout);
  const chips = app.manifest.cameras.map((camera, i) => {
    const button = make("button", {
      type: "button",
      textContent: camera.name,
      className: camera.is_heldout ? "heldout" : "",
    });
    if (camera.is_heldout) button.title = "held out: nothing is made from it";
    button.addEventListener("click", () => goToCamera(app, i));
    return button;
  });
  element("cameras").append(...chips);
  app.onState(() =>
    chips.forEach((chip, i) => {
      const isNearest = String(i === app.camera);
      if (chip.getAttribute("aria-current") !== isNearest) chip.setAttribute("aria-current", isNearest);
    }),
  );
}

function connectTurning(
  canvas: HTMLCanvasElement,
  turn: (a: number, e: number) => void,
  click: (x: number, y: number) => void,
): void {
  let last: [number, number] | null = null;
  let moved = 0;
  canvas.addEventListener("pointerdown", (event) => {
    last = [event.clientX, event.clientY];
    moved = 0;
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!last) return;
    const [dx, dy] = [event.clientX - last[0], event.clientY - last[1]];
    moved += Math.hypot(dx, dy);
    last = [event.clientX, event.clientY];
    turn(dx * 0.01, dy * 0.01);
  });
  canvas.addEventListener("pointerup", (event) => {
    last = null;
    const size = canvas.getBoundingClientRect();
    if (moved < 5)
      click(
        ((event.clientX - size.left) / size.width) * canvas.width,
        ((event.clientY - size.top) / size.height) * canvas.height,
      );
  });
  canvas.addEventListener("keydown", (event) => {
    const turns: Record<string, [number, number]> = {
      ArrowLeft: [-TURN, 0],
      ArrowRight: [TURN, 0],
      ArrowUp: [0, TURN],
      ArrowDown: [0, -TURN],
    };
    const by = turns[event.key];
    if (!by) return;
    event.preventDefault();
    turn(...by);
  });
}

/** To the place of the path that is nearest to a camera. */
export function goToCamera(app: App, camera: number): void {
  const center = centerOf(poseAt(app.manifest.cameras[camera]!, app.moment));
  const view = nearestView(center, app.manifest.views);
  app.change((state) => orbit(state, app.manifest.views[view]!.share));
}

export function connectPath(app: App): void {
  let path: Path = { keys: [], isEased: true };
  let played: number | null = null;
  const list = element("keys");
  const preview = element<HTMLButtonElement>("preview");
  const savePath = element<HTMLButtonElement>("save-path");
  const ease = element<HTMLInputElement>("ease");
  const update = (next: Path): void => {
    path = tidyPath(next);
    played = null;
    list.replaceChildren(...path.keys.map((_, i) => drawKey(app, path, i, update)));
    const isFilm = path.keys.length > 1;
    preview.disabled = savePath.disabled = !isFilm;
    showPlayed();
  };
  const showPlayed = (): void => {
    preview.textContent = played === null ? "Preview" : "Stop";
  };
  element("add-key").addEventListener("click", () =>
    update({ ...path, keys: [...path.keys, { frame: app.frame, share: app.state.share, seconds: 2 }] }),
  );
  ease.addEventListener("change", () => update({ ...path, isEased: ease.checked }));
  savePath.addEventListener("click", () =>
    save(`${app.manifest.scene}-path.json`, exportPath(path, app.manifest)),
  );
  preview.addEventListener("click", () => {
    played = played === null ? 0 : null;
    app.change((state) => ({ ...state, isPlaying: false }));
    showPlayed();
  });
  app.onTick((seconds) => {
    if (played === null) return;
    if (app.state.isPlaying) played = null;
    else {
      const { frame, share } = pathAt(path, played);
      app.change((state) => ({ ...state, share, clock: momentOfFrame(app.manifest.frames, frame) }));
      played = played > durationOf(path) ? null : played + seconds;
    }
    showPlayed();
  });
}

function drawKey(app: App, path: Path, at: number, update: (path: Path) => void): HTMLLIElement {
  const key = path.keys[at]!;
  const change = (keys: Path["keys"]): void => update({ ...path, keys });
  const moment = momentOfFrame(app.manifest.frames, key.frame);
  const outside = isOutside(app.manifest, key.share, moment) ? ", outside the cameras" : "";
  const words = `frame ${key.frame + 1}, ${Math.round(100 * key.share)} %${outside}`;
  const button = (text: string, label: string, action: () => void): HTMLButtonElement => {
    const made = make("button", {
      type: "button",
      textContent: text,
      ariaLabel: `${label} key frame ${at + 1}`,
    });
    made.addEventListener("click", action);
    return made;
  };
  const row = make("div", {}, make("span", {}, words));
  if (at > 0) {
    const seconds = make("input", {
      type: "number",
      min: "0.1",
      max: "60",
      step: "0.1",
      value: String(key.seconds),
      ariaLabel: `Seconds to key frame ${at + 1}`,
    });
    seconds.addEventListener("change", () => {
      const value = clamp(Number(seconds.value) || key.seconds, 0.1, 60);
      change(path.keys.map((other, i) => (i === at ? { ...other, seconds: value } : other)));
    });
    row.append(make("label", {}, "after ", seconds, " s"));
  }
  row.append(
    button("Go", "Go to", () =>
      app.change((s) => ({
        ...s,
        share: key.share,
        clock: moment,
        isPlaying: false,
      })),
    ),
    button("✕", "Remove", () => change(path.keys.filter((_, i) => i !== at))),
  );
  return make("li", {}, row);
}
