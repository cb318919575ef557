/** The state, its changes, and the loop that shows them. */

import { nearestCamera } from "./geometry";
import type { Manifest, Pose } from "./manifest";
import { colourMap } from "./overlay";
import { element } from "./page";
import { Pace } from "./pace";
import { poseOfShare } from "./path";
import { fileOrder, neededKeys } from "./plan";
import { type State, advance, initialState, latticePlace, momentOf, momentsPerSecond } from "./state";
import { PictureStore, browserLoader } from "./store";
import { type Renderer, type Source, makeRenderer } from "./warp";

/** Longest pause that playing makes up for; a hidden page must not jump. */
const MAX_PAUSE_S = 0.25;
/** Once nothing has changed for this long, the picture is made as well as possible. */
const REST_MS = 150;
const FIRST_PICTURE = "first picture";

export class App {
  state: State = initialState();
  readonly store: PictureStore;
  readonly numMoments: number;
  /** Real camera that is looked at whatever is nearest, or null. */
  pinnedCamera: number | null = null;
  isComparing = false;
  private readonly renderer: Renderer;
  private readonly canvas = element<HTMLCanvasElement>("picture");
  private readonly overlay = element<HTMLCanvasElement>("overlay");
  private readonly real = element<HTMLCanvasElement>("real");
  private readonly listeners: ((state: State) => void)[] = [];
  private readonly tickers: ((seconds: number) => void)[] = [];
  private last = 0;
  private isDirty = true;
  private shownMoment = -1;
  private readonly pace = new Pace();
  private isBent = false;
  private changedAt = 0;
  private drawn: unknown[] = [];

  constructor(readonly manifest: Manifest) {
    this.numMoments = manifest.frames.length;
    this.store = new PictureStore(manifest.files, browserLoader);
    this.store.onChange = () => this.invalidate();
    this.renderer = makeRenderer(this.canvas, manifest);
  }

  get moment(): number {
    return momentOf(this.state, this.numMoments);
  }

  get frame(): number {
    return this.manifest.frames[this.moment]!;
  }

  get pose(): Pose {
    return poseOfShare(this.manifest, this.state.share);
  }

  /** The two views that the picture is made from; under an overlay the nearer one alone, to fit its map. */
  get place(): [number, number, number] {
    const [first, second, weight] = latticePlace(this.state.share, this.manifest.views.length);
    if (this.state.overlay === "none") return [first, second, weight];
    const near = weight > 0.5 ? second : first;
    return [near, near, 0];
  }

  get camera(): number {
    return this.pinnedCamera ?? nearestCamera(this.pose, this.manifest.cameras, this.moment);
  }

  /** Change what is shown; everything that listens is told. */
  readonly change = (update: (state: State) => State): void => {
    const next = update(this.state);
    if (next === this.state) return;
    this.state = next;
    this.changedAt = performance.now();
    this.invalidate();
  };

  invalidate(): void {
    this.isDirty = true;
  }

  onState(listener: (state: State) => void): void {
    this.listeners.push(listener);
  }

  /** Called on every frame of the screen, with the seconds since the one before. */
  onTick(ticker: (seconds: number) => void): void {
    this.tickers.push(ticker);
  }

  start(): void {
    this.store.loadInOrder(fileOrder(this.manifest, this.place[0]));
    requestAnimationFrame((now) => {
      this.last = now;
      this.tick(now);
    });
  }

  private tick(now: number): void {
    const gap = now - this.last;
    this.pace.note(gap, this.isBent);
    this.isBent = false;
    const seconds = Math.min(gap / 1000, MAX_PAUSE_S);
    this.last = now;
    this.tickers.forEach((ticker) => ticker(seconds));
    const { fps, num_frames } = this.manifest;
    const rate = momentsPerSecond(fps, num_frames, this.numMoments);
    this.change((state) => advance(state, seconds, rate, this.numMoments));
    if (this.isDirty) {
      this.isDirty = false;
      this.show();
    } else if (this.level === 0) this.drawPicture();
    requestAnimationFrame((next) => this.tick(next));
  }

  private show(): void {
    this.listeners.forEach((listener) => listener(this.state));
    const camera = this.isComparing ? this.manifest.cameras[this.camera]!.name : null;
    this.store.want(neededKeys(this.state, this.manifest, camera));
    this.isBent = this.drawPicture();
    this.drawOverlay();
    if (camera) this.drawReal(camera);
  }

  private source(view: number, moment: number): Source | null {
    const entry = this.manifest.views[view]!;
    const picture = this.store.get({ kind: "view", name: entry.name, moment });
    if (!picture) return null;
    return { picture, map: this.store.get({ kind: "map", name: entry.name, moment }), pose: entry };
  }

  /** How carefully to draw: as fast as this computer can while something moves, then as well as possible. */
  private get level(): number {
    return performance.now() - this.changedAt > REST_MS ? 0 : this.pace.level;
  }

  /** The wanted picture, or the best that is decoded: one view, or the last moment that was. */
  private drawPicture(): boolean {
    const [first, second, weight] = this.place;
    const level = weight ? this.level : 0;
    for (const moment of new Set([this.moment, this.shownMoment])) {
      if (moment < 0) continue;
      const [a, b] = [this.source(first, moment), weight ? this.source(second, moment) : null];
      const main = a ?? b;
      if (!main) continue;
      this.shownMoment = moment;
      const wanted = [main.picture, main.map, b?.picture, b?.map, this.state.share, level];
      const isDrawn = wanted.every((part, i) => part === this.drawn[i]);
      this.drawn = wanted;
      const isBent = !isDrawn && this.renderer.draw(main, a ? b : null, weight, this.pose, level);
      this.report(moment === this.moment && !!a && (!weight || !!(b?.map && a.map)));
      return isBent;
    }
    return false;
  }

  /** For whoever measures: whether the wanted picture is shown, and when the first one was. */
  private report(isExact: boolean): void {
    this.canvas.dataset.exact = String(isExact);
    if (isExact && !performance.getEntriesByName(FIRST_PICTURE).length) performance.mark(FIRST_PICTURE);
  }

  private drawOverlay(): void {
    const context = this.overlay.getContext("2d", { willReadFrequently: true })!;
    const name = this.manifest.views[this.place[0]]!.name;
    const map = this.store.get({ kind: "map", name, moment: this.moment });
    this.overlay.hidden = this.state.overlay === "none" || !map;
    if (this.overlay.hidden || !map) return;
    this.overlay.width = map.width;
    this.overlay.height = map.height;
    context.drawImage(map, 0, 0);
    const { data } = context.getImageData(0, 0, map.width, map.height);
    context.putImageData(new ImageData(colourMap(data, this.state.overlay), map.width), 0, 0);
  }

  private drawReal(name: string): void {
    const picture = this.store.get({ kind: "camera", name, moment: this.moment });
    if (!picture) return;
    if (this.real.width !== picture.width || this.real.height !== picture.height) {
      this.real.width = picture.width;
      this.real.height = picture.height;
    }
    this.real.getContext("2d")!.drawImage(picture, 0, 0);
    this.real.dataset.camera = name;
  }
}
