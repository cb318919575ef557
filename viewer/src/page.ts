/** Elements of the page by their names. */

export function element<T extends Element = HTMLElement>(name: string): T {
  const found = document.getElementById(name);
  if (!found) throw new Error(`the page lacks the element ${name}`);
  return found as unknown as T;
}

export function make<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  settings: Partial<HTMLElementTagNameMap[K]>,
  ...children: (Node | string)[]
): HTMLElementTagNameMap[K] {
  const made = Object.assign(document.createElement(tag), settings);
  made.append(...children);
  return made;
}

/** Offer a document as a file; JSON is YAML too. */
export function save(name: string, document_: Record<string, unknown>): void {
  const blob = new Blob([JSON.stringify(document_, null, 1) + "\n"], { type: "application/json" });
  const address = URL.createObjectURL(blob);
  make("a", { href: address, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(address), 10_000);
}
