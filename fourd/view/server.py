"""What a browser on this machine is told. Bound to 127.0.0.1; other hosts' pages are turned away."""

import json
import logging
import re
import urllib.parse
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from fourd.errors import InputError
from fourd.view.job import WorkflowJob, check_scene_name, store_film
from fourd.view.live import Cancelled, LiveScenes

ADDRESS = "127.0.0.1"
# Everything that is read from the disk for a browser, and as what.
PAGE_FILE = re.compile(r"(index\.html|data/[A-Za-z0-9_.-]+\.js)")
KINDS = {".html": "text/html; charset=utf-8", ".js": "text/javascript; charset=utf-8"}
POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src 'self' data: blob:; connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; "
    "form-action 'none'"
)
# A page of another host cannot send this without asking first, which is answered with no.
OWN_HEADER = "X-Fourd"
LIVE_WIDTH = 480
DROP_PAGE = Path(__file__).with_name("drop.html")
LIVE_SCRIPT = b'<script>document.documentElement.dataset.live = "yes";</script>'

logger = logging.getLogger(__name__)


class ViewServer(ThreadingHTTPServer):
    """The server of one results folder."""

    daemon_threads = True

    def __init__(self, results: Path, job: WorkflowJob, port: int = 0) -> None:
        super().__init__((ADDRESS, port), Handler)
        self.results, self.job = results, job
        self.live = LiveScenes(results)
        self.hosts = {f"{name}:{self.server_address[1]}" for name in (ADDRESS, "localhost")}


class Handler(BaseHTTPRequestHandler):
    """One request. Faults of the user are answered with their sentence, never with a traceback."""

    server: ViewServer
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        self._answer(self._get)

    def do_POST(self) -> None:
        self._answer(self._post, is_change=True)

    def do_PUT(self) -> None:
        self._answer(self._put, is_change=True)

    def log_message(self, format: str, *args: Any) -> None:
        logger.debug(format, *args)

    def _answer(self, action: Any, is_change: bool = False) -> None:
        # A name that leads here but is not ours would let another host's page read along.
        is_own = self.headers.get("Host") in self.server.hosts
        is_foreign = self.headers.get("Sec-Fetch-Site") in ("cross-site", "same-site")
        is_own &= not (is_foreign and self.path.startswith("/api/"))
        if not is_own or (is_change and self.headers.get(OWN_HEADER) != "1"):
            self.close_connection = True
            self._send_json({"error": "only pages of this program may ask"}, HTTPStatus.FORBIDDEN)
            return
        parts = urllib.parse.urlsplit(self.path)
        query = {key: values[-1] for key, values in urllib.parse.parse_qs(parts.query).items()}
        try:
            action(parts.path, query)
        except Cancelled:
            self._send_json({"error": "another view was asked for since"}, HTTPStatus.CONFLICT)
        except InputError as error:
            # What was not read of a refused film must not be taken for the next request.
            self.close_connection = True
            self._send_json({"error": str(error)}, HTTPStatus.BAD_REQUEST)

    def _get(self, path: str, query: dict[str, str]) -> None:
        if path == "/":
            self._send(DROP_PAGE.read_bytes(), KINDS[".html"])
        elif path == "/api/run":
            self._send_json(self.server.job.state)
        elif path == "/api/live":
            self._send_json(self.server.live.state(query.get("scene", "")))
        elif path == "/api/render":
            self._send(self._render(query), "image/png")
        elif path.startswith("/scenes/"):
            self._send_page_file(path.removeprefix("/scenes/"))
        else:
            self._send_json({"error": "nothing of this name"}, HTTPStatus.NOT_FOUND)

    def _render(self, query: dict[str, str]) -> bytes:
        try:
            share, frame = float(query["share"]), int(query["frame"])
            width = int(query.get("width", LIVE_WIDTH))
        except (KeyError, ValueError):
            raise InputError("expected numbers share and frame in the address: ask again") from None
        return self.server.live.queue(check_scene_name(query.get("scene", ""))).ask(share, frame, width)

    def _send_page_file(self, path: str) -> None:
        scene, _, name = path.partition("/")
        name = name or "index.html"
        folder = (self.server.results / check_scene_name(scene) / "viewer").resolve()
        file = folder / name
        if not PAGE_FILE.fullmatch(name) or not file.resolve().is_relative_to(folder) or not file.is_file():
            words = f"{scene} has no page yet: `snakemake viewer --config scene={scene}` makes it"
            self._send_json({"error": words}, HTTPStatus.NOT_FOUND)
            return
        data = file.read_bytes()
        if name == "index.html":
            data = data.replace(b"</head>", LIVE_SCRIPT + b"</head>", 1)
        self._send(data, KINDS[file.suffix])

    def _post(self, path: str, query: dict[str, str]) -> None:
        if path == "/api/run":
            name, count = check_scene_name(query.get("scene", "")), query.get("films", "")
            if not count.isdecimal():
                raise InputError("expected the number of films: ask again")
            self.server.job.start(name, int(count), query.get("synchronized") == "1")
        elif path == "/api/cancel":
            self.server.job.cancel()
        else:
            raise InputError("nothing of this name")
        self._send_json(self.server.job.state)

    def _put(self, path: str, query: dict[str, str]) -> None:
        if path != "/api/film":
            raise InputError("nothing of this name")
        try:
            num_bytes, index = int(self.headers.get("Content-Length", "")), int(query.get("index", ""))
        except ValueError:
            raise InputError("expected the film's size and number: send it again") from None
        folder = self.server.job.films_folder(query.get("scene", ""))
        film = store_film(folder, index, query.get("suffix", ""), self.rfile, num_bytes)
        self._send_json({"name": film.name})

    def _send_json(self, document: dict[str, Any], status: HTTPStatus = HTTPStatus.OK) -> None:
        self._send(json.dumps(document).encode(), "application/json", status)

    def _send(self, data: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        self.send_response(status)
        headers = {"Content-Type": kind, "Content-Length": str(len(data)), "Cache-Control": "no-store"}
        headers |= {"Content-Security-Policy": POLICY, "X-Content-Type-Options": "nosniff"}
        headers |= {"Cross-Origin-Resource-Policy": "same-origin", "Referrer-Policy": "no-referrer"}
        for key, value in headers.items():
            self.send_header(key, value)
        self.end_headers()
        try:
            self.wfile.write(data)
        except (BrokenPipeError, ConnectionResetError):
            # The page has gone on to another view.
            self.close_connection = True
