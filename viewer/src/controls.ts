/** Sliders, buttons and words around the stage. */

import type { App } from "./app";
import { centerOf, dot, length, subtract } from "./geometry";
import { formatLink, readLink } from "./link";
import { legendOf } from "./overlay";
import { applyKey } from "./input";
import { element, make } from "./page";
import { isOutside } from "./path";
import { type Overlay, SPEEDS, type State, clamp, orbit, seek, stepMoment, togglePlay } from "./state";

// The address bar is written at most this often; browsers stop pages that write it on every frame.
const LINK_INTERVAL_MS = 400;

export function connectControls(app: App): void {
  const { manifest, change, numMoments } = app;
  const time = element<HTMLInputElement>("time");
  const view = element<HTMLInputElement>("view");
  const speed = element<HTMLSelectElement>("speed");
  const loop = element<HTMLInputElement>("loop");
  const shown = element<HTMLSelectElement>("shown");
  const play = element("play");
  time.max = String(numMoments - 1);
  speed.append(...SPEEDS.map((value) => make("option", { value: String(value), textContent: `${value}×` })));
  element("title").textContent = manifest.scene;
  document.title = `${manifest.scene} - fourd`;

  time.addEventListener("input", () =>
    change((s) => seek({ ...s, isPlaying: false }, Number(time.value), numMoments)),
  );
  view.addEventListener("input", () => change((s) => orbit(s, Number(view.value))));
  // Its own steps are as fine as the drag needs, a thousand from end to end.
  view.addEventListener("keydown", (event) => {
    const key = { ArrowUp: "ArrowRight", ArrowDown: "ArrowLeft" }[event.key] ?? event.key;
    if (key !== "ArrowLeft" && key !== "ArrowRight") return;
    event.preventDefault();
    change((s) => applyKey(key, event.shiftKey, s, numMoments)!);
  });
  play.addEventListener("click", () => change((s) => togglePlay(s, numMoments)));
  element("back").addEventListener("click", () => change((s) => stepMoment(s, -1, numMoments)));
  element("forward").addEventListener("click", () => change((s) => stepMoment(s, 1, numMoments)));
  speed.addEventListener("change", () => change((s) => ({ ...s, speed: Number(speed.value) })));
  loop.addEventListener("change", () => change((s) => ({ ...s, isLooping: loop.checked })));
  shown.addEventListener("change", () => change((s) => ({ ...s, overlay: shown.value as Overlay })));
  connectCompare(app);
  connectLink(app);

  app.onState((state) => {
    time.value = String(app.moment);
    view.value = String(state.share);
    speed.value = String(state.speed);
    loop.checked = state.isLooping;
    shown.value = state.overlay;
    play.textContent = state.isPlaying ? "Pause" : "Play";
    const frame = `frame ${app.frame + 1} of ${manifest.num_frames}`;
    const seconds = `${(app.frame / manifest.fps).toFixed(2)} s`;
    element("time-text").textContent = `${seconds}, ${frame.replace("frame ", "").replace(" of ", "/")}`;
    time.setAttribute("aria-valuetext", `${seconds}, ${frame}`);
    const outside = isOutside(manifest, state.share, app.moment) ? ", outside the cameras" : "";
    const place = describePlace(app) + outside;
    element("view-text").textContent = place;
    view.setAttribute("aria-valuetext", place);
    showLegend(app, state);
  });
  showProgress(app);
}

/** Where the view stands, in words: at a camera, or between two. */
export function describePlace(app: App): string {
  const center = centerOf(app.pose);
  const toRight = app.pose.R.slice(0, 3);
  const cameras = app.manifest.cameras.map((camera) => {
    const offset = subtract(centerOf(camera.poses[Math.min(app.moment, camera.poses.length - 1)]!), center);
    return { name: camera.name, distance: length(offset), side: dot(offset, toRight) };
  });
  cameras.sort((a, b) => a.distance - b.distance);
  const nearest = cameras[0]!;
  const other = cameras.find((camera) => camera.side * nearest.side < 0);
  if (!other || nearest.distance <= 0.15 * other.distance) return `at ${nearest.name}`;
  const [left, right] = nearest.side < 0 ? [nearest, other] : [other, nearest];
  return `${left.name} – ${right.name}`;
}

function connectCompare(app: App): void {
  const compare = element<HTMLInputElement>("compare");
  const cut = element<HTMLInputElement>("cut");
  const stage = element("stage");
  const update = (): void => {
    app.isComparing = compare.checked;
    document.querySelector(".player")!.classList.toggle("comparing", compare.checked);
    for (const name of ["real", "cutline", "realname"])
      element(name).toggleAttribute("hidden", !compare.checked);
    stage.style.setProperty("--cut", `${cut.value}%`);
    element("cut-text").textContent = `${cut.value} % render`;
    app.invalidate();
  };
  compare.addEventListener("change", update);
  cut.addEventListener("input", update);
  connectDivider(element("cutline"), stage, (share) => {
    cut.value = String(Math.round(100 * share));
    update();
  });
  app.onState(() => {
    element("realname").textContent = `${app.manifest.cameras[app.camera]!.name}, as filmed`;
  });
  update();
}

/** The line between render and real picture is dragged like a slider. */
function connectDivider(divider: HTMLElement, stage: HTMLElement, move: (share: number) => void): void {
  divider.addEventListener("pointerdown", (event) => {
    // The stage below would take it for a move of the view.
    event.stopPropagation();
    divider.setPointerCapture(event.pointerId);
  });
  divider.addEventListener("pointermove", (event) => {
    if (!divider.hasPointerCapture(event.pointerId)) return;
    event.stopPropagation();
    const { left, width } = stage.getBoundingClientRect();
    move(clamp((event.clientX - left) / width, 0, 1));
  });
}

function connectLink(app: App): void {
  const copy = element("copy");
  let written = "";
  let next = 0;
  const write = (): void => {
    const link = formatLink(app.state, app.manifest.frames);
    if (link === written) return;
    written = link;
    history.replaceState(null, "", link);
  };
  app.onTick(() => {
    if (performance.now() < next || app.state.isPlaying) return;
    next = performance.now() + LINK_INTERVAL_MS;
    write();
  });
  window.addEventListener("hashchange", () => app.change((s) => readLink(location.hash, s, app.manifest)));
  copy.addEventListener("click", () => {
    write();
    const done = (text: string): void => {
      copy.textContent = text;
      setTimeout(() => (copy.textContent = "Copy link"), 1500);
    };
    navigator.clipboard.writeText(location.href).then(
      () => done("Copied"),
      () => done("It is in the address bar"),
    );
  });
}

function showLegend(app: App, state: State): void {
  const legend = element("legend");
  legend.hidden = state.overlay === "none";
  if (legend.dataset.overlay === state.overlay) return;
  legend.dataset.overlay = state.overlay;
  legend.replaceChildren(
    ...legendOf(state.overlay, app.manifest).map(([colour, text]) => {
      const dot_ = make("i", {});
      dot_.style.background = `rgb(${colour.join(" ")})`;
      return make("li", {}, dot_, text);
    }),
  );
}

function showProgress(app: App): void {
  const status = element("status");
  const failed: string[] = [];
  app.store.onError = (file) => failed.push(file);
  app.onState(() => {
    const share = app.store.progress;
    const { num_frames, views } = app.manifest;
    const clip = app.numMoments < num_frames ? ` of a clip of ${num_frames} frames` : "";
    const done = `${app.numMoments} moments from ${views.length} places${clip}`;
    const text = failed.length
      ? `${failed.length} files of this page are missing, first data/${failed[0]!}: copy the whole folder`
      : share < 1
        ? `loading, ${Math.floor(100 * share)} %`
        : done;
    // A screen reader says what it comes to, not every per cent of the way.
    status.setAttribute("aria-busy", String(share < 1 && !failed.length));
    if (status.textContent !== text) status.textContent = text;
  });
}
