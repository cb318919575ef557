import { defineConfig } from "vite";

// One classic script and one style sheet: what a page opened from the disk may run.
export default defineConfig({
  build: {
    outDir: "../fourd/viewer/assets",
    emptyOutDir: true,
    target: "es2022",
    lib: {
      entry: "src/main.ts",
      formats: ["iife"],
      name: "fourdViewer",
      fileName: () => "viewer.js",
      cssFileName: "viewer",
    },
  },
});
