"""`python -m fourd.view [SCENE]`: a scene's page on this machine, or a place to drop videos."""

import argparse
import contextlib
import os
import signal
import sys
import webbrowser
from collections.abc import Sequence
from pathlib import Path

from fourd.cli import run_stage, set_num_threads
from fourd.errors import InputError
from fourd.view.job import WorkflowJob, check_scene_name
from fourd.view.server import ADDRESS, ViewServer


def main(argv: Sequence[str] | None = None) -> None:
    """Command line. Raises InputError for a scene without a page, or a port that is taken."""
    parser = argparse.ArgumentParser(prog="python -m fourd.view", description=__doc__)
    parser.add_argument("scene", nargs="?", help="what to show; without it, a page to drop videos on")
    parser.add_argument("--results", type=Path, default=Path("results"))
    parser.add_argument("--port", type=int, default=8264, help="0 takes any that is free")
    parser.add_argument("--cores", type=int, default=os.cpu_count() or 1, help="for the workflow")
    parser.add_argument("--no-browser", action="store_true", help="only say the address")
    args = parser.parse_args(argv)
    set_num_threads(1)
    path = ""
    if args.scene:
        page = args.results / check_scene_name(args.scene) / "viewer" / "index.html"
        if not page.is_file():
            raise InputError(
                f"expected the page of {args.scene} at {page}, found nothing: "
                f"`snakemake --cores {args.cores} viewer --config scene={args.scene}` makes it"
            )
        path = f"scenes/{args.scene}/"
    with open_server(args.results, WorkflowJob(Path.cwd(), args.cores), args.port) as server:
        address = f"http://{ADDRESS}:{server.server_address[1]}/{path}"
        print(f"{address}\nStop with Ctrl-C.", flush=True)
        if not args.no_browser:
            webbrowser.open(address)
        # A run that was started here ends with it, however it is ended.
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
        try:
            with contextlib.suppress(KeyboardInterrupt):
                server.serve_forever()
        finally:
            server.job.cancel()


def open_server(results: Path, job: WorkflowJob, port: int) -> ViewServer:
    """The server, listening. Raises InputError if it may not have the port."""
    try:
        return ViewServer(results, job, port)
    except OSError as error:
        raise InputError(
            f"expected port {port} to be free, got: {error.strerror}: stop what has it, or say --port 0"
        ) from None


if __name__ == "__main__":
    sys.exit(run_stage(main))
