/** How carefully pictures between views are made, so that the page moves as fast as it can anywhere. */

/** Finest first: bent as well as possible, bent coarsely, only mixed. */
export const LEVELS = 3;
// Frames of the screen that are looked at before a level is judged.
const PATIENCE = 8;
// Slower than an idle page by this factor is too slow: the screen's own rate is not known.
const SLOWER = 1.5;

export class Pace {
  level = 0;
  private idle = 1000 / 60;
  private busy = 0;
  private count = 0;

  /** gap: milliseconds between two frames of the screen;  isBusy: a picture was bent in between. */
  note(gap: number, isBusy: boolean): void {
    if (!isBusy) {
      this.idle += 0.1 * (Math.min(gap, 100) - this.idle);
      return;
    }
    this.busy += (gap - this.busy) / ++this.count;
    if (this.count < PATIENCE) return;
    if (this.busy > SLOWER * this.idle) this.level = Math.min(this.level + 1, LEVELS - 1);
    this.busy = this.count = 0;
  }
}
