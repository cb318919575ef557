/** Addresses of a moment and a view: `#t=FRAME&v=SHARE`, with `&o=OVERLAY` where one is shown. */

import { type Manifest, momentOfFrame } from "./manifest";
import { OVERLAYS, type Overlay, type State, clamp, momentOf } from "./state";

export function formatLink(state: State, frames: number[]): string {
  const frame = frames[momentOf(state, frames.length)]!;
  const overlay = state.overlay === "none" ? "" : `&o=${state.overlay}`;
  return `#t=${frame}&v=${state.share.toFixed(4)}${overlay}`;
}

/** The state that an address asks for; what it does not say, or says wrongly, stays as it is. */
export function readLink(hash: string, state: State, manifest: Pick<Manifest, "frames">): State {
  const words = new URLSearchParams(hash.replace(/^#/, ""));
  const next = { ...state };
  const frame = Number.parseInt(words.get("t") ?? "", 10);
  if (Number.isFinite(frame)) next.clock = momentOfFrame(manifest.frames, frame);
  const share = Number.parseFloat(words.get("v") ?? "");
  if (Number.isFinite(share)) next.share = clamp(share, 0, 1);
  const overlay = words.get("o") as Overlay;
  if (OVERLAYS.includes(overlay)) next.overlay = overlay;
  return next;
}
