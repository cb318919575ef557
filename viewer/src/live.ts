/** Exact pictures between views, where the page is served by `python -m fourd.view`. */

import type { App } from "./app";
import { element, make } from "./page";
import { latticePlace } from "./state";

// The place must rest for this long; moving through views asks for none.
const REST_MS = 350;
const PROGRESS_MS = 400;

export function connectLive(app: App): void {
  if (document.documentElement.dataset.live !== "yes") return;
  const stage = element("stage");
  const picture = make("img", { id: "live", hidden: true, alt: "" });
  const words = make("span", { id: "liveword", hidden: true });
  element("picture").after(picture);
  stage.append(words);
  let asked = "";
  let rests = 0;
  let abort: AbortController | null = null;

  const forget = (): void => {
    abort?.abort();
    abort = null;
    picture.hidden = words.hidden = true;
  };
  const ask = async (address: string): Promise<void> => {
    abort = new AbortController();
    const { signal } = abort;
    words.hidden = false;
    words.textContent = "rendering";
    const watch = setInterval(() => void showStep(signal), PROGRESS_MS);
    try {
      const answer = await fetch(address, { signal });
      if (signal.aborted || answer.status === 409) return;
      if (!answer.ok) {
        words.textContent = ((await answer.json()) as { error: string }).error;
        return;
      }
      const bitmap = URL.createObjectURL(await answer.blob());
      picture.onload = () => URL.revokeObjectURL(bitmap);
      picture.src = bitmap;
      picture.hidden = false;
      words.textContent = "rendered live";
    } catch {
      if (!signal.aborted) words.textContent = "the program has ended";
    } finally {
      clearInterval(watch);
    }
  };
  const showStep = async (signal: AbortSignal): Promise<void> => {
    try {
      const answer = await fetch(`/api/live?${new URLSearchParams({ scene: app.manifest.scene })}`, {
        signal,
      });
      const { step, share } = (await answer.json()) as { step: string; share: number };
      if (!signal.aborted && picture.hidden && step !== "idle")
        words.textContent = `rendering: ${step}, ${Math.round(100 * share)} %`;
    } catch {
      // The picture's own request says what is wrong.
    }
  };
  app.onTick((seconds) => {
    const [, , weight] = latticePlace(app.state.share, app.manifest.views.length);
    const query = new URLSearchParams({
      scene: app.manifest.scene,
      share: app.state.share.toFixed(4),
      frame: String(app.frame),
    });
    const address = `/api/render?${query}`;
    if (address !== asked) {
      asked = address;
      rests = 0;
      forget();
    }
    const before = rests;
    rests += 1000 * seconds;
    const isWanted = weight > 0 && app.state.overlay === "none" && !app.state.isPlaying;
    if (isWanted && before < REST_MS && rests >= REST_MS) void ask(address);
  });
}
