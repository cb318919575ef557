/** What is shown: a moment, a place, and how it goes on. Pure functions over one plain object. */

export type Overlay = "none" | "depth" | "origin" | "holes" | "hull";
export const OVERLAYS: Overlay[] = ["none", "depth", "origin", "holes", "hull"];
export const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];

export interface State {
  /** Moments passed since the first, in [0, number of moments). */
  clock: number;
  /** Place on the path, 0 to 1. */
  share: number;
  isPlaying: boolean;
  speed: number;
  isLooping: boolean;
  overlay: Overlay;
}

export function initialState(): State {
  return { clock: 0, share: 0.5, isPlaying: false, speed: 1, isLooping: true, overlay: "none" };
}

export function clamp(value: number, low: number, high: number): number {
  return Math.min(Math.max(value, low), high);
}

export function momentOf(state: State, numMoments: number): number {
  return clamp(Math.floor(state.clock), 0, numMoments - 1);
}

/** Moments shown per second at speed 1, so that the clip lasts as long as the event. */
export function momentsPerSecond(fps: number, numFrames: number, numMoments: number): number {
  return (fps * numMoments) / numFrames;
}

/** The state after some seconds of playing; at the end it starts again or stops. */
export function advance(state: State, seconds: number, rate: number, numMoments: number): State {
  if (!state.isPlaying) return state;
  const clock = state.clock + seconds * rate * state.speed;
  if (clock < numMoments) return { ...state, clock };
  if (state.isLooping) return { ...state, clock: clock % numMoments };
  return { ...state, clock: numMoments - 1, isPlaying: false };
}

/** Whole moments forward or back; playing stops. */
export function stepMoment(state: State, step: number, numMoments: number): State {
  const moment = momentOf(state, numMoments) + step;
  const wrapped = state.isLooping ? ((moment % numMoments) + numMoments) % numMoments : moment;
  return { ...state, clock: clamp(wrapped, 0, numMoments - 1), isPlaying: false };
}

export function seek(state: State, moment: number, numMoments: number): State {
  return { ...state, clock: clamp(moment, 0, numMoments - 1) };
}

export function orbit(state: State, share: number): State {
  return { ...state, share: clamp(share, 0, 1) };
}

/** Play from the start again if it stands at the end. */
export function togglePlay(state: State, numMoments: number): State {
  const atEnd = !state.isLooping && momentOf(state, numMoments) === numMoments - 1;
  return { ...state, isPlaying: !state.isPlaying, clock: !state.isPlaying && atEnd ? 0 : state.clock };
}

export function changeSpeed(state: State, direction: number): State {
  const at = SPEEDS.indexOf(state.speed) + direction;
  return { ...state, speed: SPEEDS[clamp(at, 0, SPEEDS.length - 1)]! };
}

/** The two neighbouring views of the lattice at a place, and the weight of the second. */
export function latticePlace(share: number, numViews: number): [number, number, number] {
  const place = clamp(share, 0, 1) * (numViews - 1);
  const first = Math.min(Math.floor(place), numViews - 2);
  const weight = place - first;
  // A place within a thousandth of a view is that view: its picture is shown as it was rendered.
  if (weight < 1e-3) return [first, first, 0];
  if (weight > 1 - 1e-3) return [first + 1, first + 1, 0];
  return [first, first + 1, weight];
}
