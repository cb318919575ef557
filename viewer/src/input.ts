/** Hands on the stage: drag, touch, wheel and keys, as changes of moment and place. */

import { type State, changeSpeed, orbit, seek, stepMoment, togglePlay } from "./state";

/** Share of the path passed by a drag over the stage's whole width. */
const SHARE_PER_WIDTH = 0.9;
const SHARE_PER_STEP = 0.02;
const SCROLLING = new Set(["ArrowUp", "ArrowDown", "Home", "End"]);
const WHEEL_SHARE = 0.0004;
const WHEEL_MOMENTS = 0.03;

export type Change = (change: (state: State) => State) => void;

/** The state after a key, or null for a key that means nothing here. */
export function applyKey(key: string, isShift: boolean, state: State, numMoments: number): State | null {
  const far = isShift ? 5 : 1;
  switch (key) {
    case "ArrowRight":
      return orbit(state, state.share + far * SHARE_PER_STEP);
    case "ArrowLeft":
      return orbit(state, state.share - far * SHARE_PER_STEP);
    case "ArrowUp":
    case ".":
      return stepMoment(state, far, numMoments);
    case "ArrowDown":
    case ",":
      return stepMoment(state, -far, numMoments);
    case "Home":
      return seek({ ...state, isPlaying: false }, 0, numMoments);
    case "End":
      return seek({ ...state, isPlaying: false }, numMoments - 1, numMoments);
    case " ":
    case "k":
      return togglePlay(state, numMoments);
    case "l":
      return { ...state, isLooping: !state.isLooping };
    case "[":
    case "<":
      return changeSpeed(state, -1);
    case "]":
    case ">":
      return changeSpeed(state, 1);
    default:
      return null;
  }
}

/** The state after a drag: across moves the view, up and down (or with shift) the time. */
export function applyDrag(state: State, dx: number, dy: number, isTime: boolean, numMoments: number): State {
  if (isTime)
    return seek({ ...state, isPlaying: false }, state.clock + (dx || -dy) * numMoments, numMoments - 1e-6);
  return orbit(state, state.share - dx * SHARE_PER_WIDTH);
}

/** Keep the clock within the clip; it may stand between two moments while it is dragged. */
export function applyWheel(
  state: State,
  deltaX: number,
  deltaY: number,
  isShift: boolean,
  numMoments: number,
): State {
  if (isShift || Math.abs(deltaX) > Math.abs(deltaY))
    return orbit(state, state.share + (deltaX || deltaY) * WHEEL_SHARE);
  return seek({ ...state, isPlaying: false }, state.clock + deltaY * WHEEL_MOMENTS, numMoments - 1e-6);
}

export function listen(stage: HTMLElement, change: Change, numMoments: number): void {
  let last: [number, number] | null = null;
  let isTime: boolean | null = null;
  stage.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    last = [event.clientX, event.clientY];
    isTime = event.shiftKey ? true : null;
    stage.setPointerCapture(event.pointerId);
  });
  stage.addEventListener("pointermove", (event) => {
    if (!last) return;
    const dx = (event.clientX - last[0]) / stage.clientWidth;
    const dy = (event.clientY - last[1]) / stage.clientHeight;
    // The first few pixels of a drag decide whether it moves the view or the time.
    if (isTime === null) {
      if (Math.hypot(event.clientX - last[0], event.clientY - last[1]) < 4) return;
      isTime = Math.abs(dy) > Math.abs(dx);
    }
    const along = isTime;
    last = [event.clientX, event.clientY];
    change((state) => applyDrag(state, along && !event.shiftKey ? 0 : dx, dy, along, numMoments));
  });
  const end = (): void => void (last = null);
  stage.addEventListener("pointerup", end);
  stage.addEventListener("pointercancel", end);
  stage.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      change((state) => applyWheel(state, event.deltaX, event.deltaY, event.shiftKey, numMoments));
    },
    { passive: false },
  );
  document.addEventListener("keydown", (event) => {
    // Other controls have keys of their own; where nothing has the focus, the page is scrolled by these.
    const isOurs = event.target === stage || (event.target === document.body && !SCROLLING.has(event.key));
    if (!isOurs || event.ctrlKey || event.metaKey || event.altKey) return;
    change((state) => {
      const next = applyKey(event.key, event.shiftKey, state, numMoments);
      if (next) event.preventDefault();
      return next ?? state;
    });
  });
}
