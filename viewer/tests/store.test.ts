import { describe, expect, it } from "vitest";
import { fileOrder, neededKeys } from "../src/plan";
import { initialState } from "../src/state";
import { type Key, PictureStore, Recent, fileOf, textOf } from "../src/store";
import { makeManifest } from "./scene";

const settle = (): Promise<void> => new Promise((resolve) => setTimeout(resolve, 5));
const bitmap = (): ImageBitmap => ({ width: 10, height: 10, close: () => undefined }) as ImageBitmap;

describe("recent things", () => {
  it("give up the least recently used first", () => {
    const gone: string[] = [];
    const recent = new Recent<string>(30, (item) => gone.push(item));
    for (const name of ["a", "b", "c"]) recent.put(name, name, 10);
    recent.get("a");
    recent.put("d", "d", 10);
    expect(gone).toEqual(["b"]);
    expect([recent.has("a"), recent.has("b")]).toEqual([true, false]);
  });

  it("keep one that is larger than all the room", () => {
    const recent = new Recent<string>(5, () => undefined);
    recent.put("big", "big", 100);
    expect(recent.get("big")).toBe("big");
  });
});

describe("store", () => {
  const key: Key = { kind: "view", name: "lattice-02", moment: 3 };

  it("names the file that holds a picture", () => {
    expect(fileOf(key)).toBe("view-lattice-02-0.js");
    expect(fileOf({ ...key, moment: 32 })).toBe("view-lattice-02-1.js");
  });

  it("loads what is wanted first, decodes it, and says so", async () => {
    const asked: string[] = [];
    const files = ["view-lattice-00-0.js", "view-lattice-01-0.js", "view-lattice-02-0.js"];
    const store: PictureStore = new PictureStore(files, {
      load: async (file) => {
        asked.push(file);
        const name = file.slice(5, -5);
        store.receive(["view", name, 0], ["p0", "p1", "p2", "p3"]);
      },
      decode: async (text) => (expect(text).toBe("p3"), bitmap()),
    });
    let changes = 0;
    store.onChange = () => changes++;
    store.want([key]);
    await settle();
    expect(asked[0]).toBe("view-lattice-02-0.js");
    expect(new Set(asked).size).toBe(3);
    expect(store.get(key)).toBeDefined();
    expect(store.progress).toBe(1);
    expect(changes).toBeGreaterThan(3);
  });

  it("says which file is missing and goes on", async () => {
    const missing: string[] = [];
    const store: PictureStore = new PictureStore(["view-lattice-02-0.js", "view-lattice-01-0.js"], {
      load: async (file) => {
        if (file.includes("02")) throw new Error(file);
        store.receive(["view", "lattice-01", 0], ["p0"]);
      },
      decode: async () => bitmap(),
    });
    store.onError = (file) => missing.push(file);
    store.want([key, { ...key, name: "lattice-01", moment: 0 }]);
    await settle();
    expect(missing).toEqual(["view-lattice-02-0.js"]);
    expect(store.get({ ...key, name: "lattice-01", moment: 0 })).toBeDefined();
  });
});

describe("what is needed", () => {
  const manifest = makeManifest();

  it("begins with what is shown, of both neighbours with their maps", () => {
    const keys = neededKeys({ ...initialState(), share: 0.3, clock: 2 }, manifest, "cam02").map(textOf);
    expect(keys[0]).toBe("view/lattice-01/2");
    expect(keys.slice(0, 6)).toEqual(
      expect.arrayContaining(["view/lattice-02/2", "map/lattice-01/2", "map/lattice-02/2", "camera/cam02/2"]),
    );
  });

  it("looks ahead while it plays, around the end in a loop", () => {
    const keys = neededKeys({ ...initialState(), isPlaying: true, clock: 5 }, manifest, null).map(textOf);
    expect(keys).toContain("view/lattice-02/0");
    expect(keys).not.toContain("view/lattice-03/5");
    const once = neededKeys(
      { ...initialState(), isPlaying: true, isLooping: false, clock: 5 },
      manifest,
      null,
    );
    expect(new Set(once.map((key) => key.moment))).toEqual(new Set([5]));
  });

  it("names only pictures that there are", () => {
    for (const share of [0, 0.01, 0.5, 0.99, 1])
      for (const key of neededKeys({ ...initialState(), share, clock: 0 }, manifest, "cam00")) {
        expect(key.moment).toBeGreaterThanOrEqual(0);
        expect(key.moment).toBeLessThan(manifest.frames.length);
        expect(manifest.files).toContain(fileOf(key));
      }
  });

  it("loads from the shown view outwards", () => {
    const order = fileOrder(manifest, 2);
    expect(order.slice(0, 2)).toEqual(["view-lattice-02-0.js", "map-lattice-02-0.js"]);
    expect(order[order.length - 1]).toContain("camera");
    expect([...order].sort()).toEqual([...manifest.files].sort());
  });
});
