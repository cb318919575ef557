/** Pictures: which scripts to load, which pictures to decode, which decoded ones to keep. */

export type Kind = "view" | "map" | "camera";
export interface Key {
  kind: Kind;
  name: string;
  moment: number;
}

/** Pictures in one script, as in fourd/viewer/pack.py. */
export const RUN_LENGTH = 32;

export const textOf = (key: Key): string => `${key.kind}/${key.name}/${key.moment}`;
export const fileOf = (key: Key): string =>
  `${key.kind}-${key.name}-${Math.floor(key.moment / RUN_LENGTH)}.js`;

/** Things of known size, of which the least recently used go first. */
export class Recent<T> {
  private readonly items = new Map<string, { item: T; bytes: number }>();
  private bytes = 0;

  constructor(
    private readonly maxBytes: number,
    private readonly release: (item: T) => void,
  ) {}

  get(name: string): T | undefined {
    const entry = this.items.get(name);
    if (!entry) return undefined;
    this.items.delete(name);
    this.items.set(name, entry);
    return entry.item;
  }

  has(name: string): boolean {
    return this.items.has(name);
  }

  put(name: string, item: T, bytes: number): void {
    const known = this.items.get(name);
    if (known) {
      this.items.delete(name);
      this.bytes -= known.bytes;
      if (known.item !== item) this.release(known.item);
    }
    this.items.set(name, { item, bytes });
    this.bytes += bytes;
    for (const [oldest, entry] of this.items) {
      if (this.bytes <= this.maxBytes || oldest === name) break;
      this.items.delete(oldest);
      this.bytes -= entry.bytes;
      this.release(entry.item);
    }
  }
}

export interface Loader {
  /** Run a script that lies beside the page; it hands its pictures to `receive`. */
  load(file: string): Promise<void>;
  decode(text: string): Promise<ImageBitmap>;
}

const PARALLEL_FILES = 2;
const PARALLEL_DECODES = 4;
const MAX_BYTES = 192e6;

export class PictureStore {
  private readonly texts = new Map<string, string>();
  private readonly decoded = new Recent<ImageBitmap>(MAX_BYTES, (bitmap) => bitmap.close());
  private readonly loaded = new Set<string>();
  private readonly failed = new Set<string>();
  private readonly decoding = new Set<string>();
  private wanted: Key[] = [];
  private rest: string[];
  private numLoading = 0;
  onChange: () => void = () => undefined;
  onError: (file: string) => void = () => undefined;

  constructor(
    private readonly files: string[],
    private readonly loader: Loader,
  ) {
    this.rest = [...files];
  }

  receive([kind, name, first]: [Kind, string, number], words: string[]): void {
    words.forEach((word, i) => this.texts.set(textOf({ kind, name, moment: first + i }), word));
  }

  /** The decoded picture, if it is there now. */
  get(key: Key): ImageBitmap | undefined {
    return this.decoded.get(textOf(key));
  }

  /** Say what is needed, most urgent first; it replaces what was needed before. */
  want(keys: Key[]): void {
    this.wanted = keys;
    this.work();
  }

  /** Order in which files that nothing asks for are loaded. */
  loadInOrder(files: string[]): void {
    this.rest = files.filter((file) => !this.loaded.has(file));
    this.work();
  }

  get progress(): number {
    return this.files.length ? this.loaded.size / this.files.length : 1;
  }

  private work(): void {
    for (const key of this.wanted) {
      if (this.decoding.size >= PARALLEL_DECODES) break;
      this.startDecode(key);
    }
    const urgent = this.wanted.map(fileOf);
    while (this.numLoading < PARALLEL_FILES) {
      const file = [...urgent, ...this.rest].find((name) => this.isMissing(name));
      if (!file) break;
      this.startLoad(file);
    }
  }

  private isMissing(file: string): boolean {
    return !this.loaded.has(file) && !this.failed.has(file) && this.files.includes(file);
  }

  private startLoad(file: string): void {
    this.loaded.add(file);
    this.numLoading++;
    const done = (): void => {
      this.numLoading--;
      this.onChange();
      this.work();
    };
    this.loader.load(file).then(done, () => {
      this.loaded.delete(file);
      this.failed.add(file);
      this.onError(file);
      done();
    });
  }

  private startDecode(key: Key): void {
    const name = textOf(key);
    const text = this.texts.get(name);
    if (text === undefined || this.decoding.has(name) || this.decoded.has(name)) return;
    this.decoding.add(name);
    const done = (): void => {
      this.decoding.delete(name);
      this.onChange();
      this.work();
    };
    this.loader.decode(text).then(
      (bitmap) => {
        this.decoded.put(name, bitmap, 4 * bitmap.width * bitmap.height);
        done();
      },
      () => {
        this.texts.delete(name);
        this.onError(name);
        done();
      },
    );
  }
}

/** Scripts and pictures of a page, from the disk or from a host. */
export const browserLoader: Loader = {
  load: (file) =>
    new Promise((resolve, reject) => {
      const script = document.createElement("script");
      script.src = `data/${file}`;
      script.onload = () => {
        script.remove();
        resolve();
      };
      script.onerror = () => reject(new Error(file));
      document.head.append(script);
    }),
  decode: (text) => {
    const bytes = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
    // Maps are numbers: no colour management, no alpha.
    return createImageBitmap(new Blob([bytes], { type: "image/webp" }), {
      colorSpaceConversion: "none",
      premultiplyAlpha: "none",
    });
  },
};
