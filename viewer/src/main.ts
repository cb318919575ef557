/** Start of the page. */

import "./style.css";
import { App } from "./app";
import { connectControls } from "./controls";
import { listen } from "./input";
import { readLink } from "./link";
import { connectLive } from "./live";
import type { Manifest } from "./manifest";
import { connectMark } from "./marking";
import { element } from "./page";
import { connectMap, connectPath } from "./panels";

const manifest = JSON.parse(element("manifest").textContent!) as Manifest;
const app = new App(manifest);
// Scripts with pictures hand them over by this name.
Object.assign(window, { fourd: { receive: app.store.receive.bind(app.store) } });
app.change((state) => readLink(location.hash, state, manifest));
connectControls(app);
connectMark(app);
listen(element("stage"), app.change, app.numMoments);
connectMap(app);
connectPath(app);
connectLive(app);
app.start();
