"""The server of the page, on this machine only."""

import html
import logging
import pathlib
import secrets
import signal
import socket
import sys
import tempfile
import threading
import webbrowser
from collections.abc import Callable
from typing import Any

import uvicorn  # pyright: ignore[reportMissingImports]  # the extra `explore`
from fastapi import FastAPI  # pyright: ignore[reportMissingImports]
from nicegui import ui  # pyright: ignore[reportMissingImports]

from diffabs.output.explore import page
from diffabs.output.explore.guard import LOOPBACK_ADDRESS, Guard
from diffabs.output.explore.session import Tools

SHUTDOWN_S = 1  # s that open pages have to close their connections
# Python's interval between thread switches. At the default of 5e-3 s a busy thread delays every curve several times.
THREAD_SWITCH_S = 5e-4


def open_listener(port: int | None, usual_port: int) -> socket.socket:
    """Return a listening socket at a port; without one, at the usual port, or at any free one where that is in use.

    It listens before the server starts, so that a port in use is reported at once.
    """
    try:
        return socket.create_server((LOOPBACK_ADDRESS, usual_port if port is None else port))
    except OSError:
        if port is not None:
            raise
        return socket.create_server((LOOPBACK_ADDRESS, 0))


def serve(
    source: str,
    tools: Tools,
    folder: pathlib.Path,
    listener: socket.socket,
    *,
    thread: str,
    ready: Callable[[str], None] = lambda url: None,
    browser: bool = False,
) -> None:
    """Serve the page of a scenario, with one session for each tab, until the process is interrupted."""
    port, token = listener.getsockname()[1], secrets.token_urlsafe(24)
    url = f"http://{LOOPBACK_ADDRESS}:{port}/?token={token}"
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)

    @ui.page("/", title="diffabs explore", favicon="📈")
    async def opened() -> None:
        await page.show(source, tools, folder, thread)

    ui.run_with(app, show_welcome_message=False, gzip_middleware_factory=None, reconnect_timeout=5.0, tailwind=True)
    guarded: Any = Guard(app, port, token)
    config = uvicorn.Config(
        guarded, log_level="error", access_log=False, timeout_graceful_shutdown=SHUTDOWN_S, lifespan="on", ws="auto"
    )
    server = uvicorn.Server(config)
    logging.getLogger("nicegui").setLevel(logging.ERROR)  # hides messages about missing pages
    sys.setswitchinterval(THREAD_SWITCH_S)

    def announce() -> None:
        while not server.started and not server.should_exit:
            threading.Event().wait(0.02)
        if server.started:
            ready(url)
            if browser:
                webbrowser.open(write_redirect_file(url, pathlib.Path(private)).as_uri())

    hang_up = getattr(signal, "SIGHUP", None)  # a closed terminal; uvicorn hears only SIGINT and SIGTERM
    answer = signal.getsignal(hang_up) if hang_up else None

    def end_on_hang_up(number: int, frame: Any) -> None:
        if callable(answer):
            answer(number, frame)
        server.should_exit = True

    if hang_up and callable(answer):
        signal.signal(hang_up, end_on_hang_up)
    with tempfile.TemporaryDirectory(prefix="diffabs-explore-") as private:
        threading.Thread(target=announce, daemon=True).start()
        server.run(sockets=[listener])
    if not server.started:
        raise OSError(f"no page can be served at http://{LOOPBACK_ADDRESS}:{port}/")


def write_redirect_file(url: str, folder: pathlib.Path) -> pathlib.Path:
    """Return the path of a new HTML file, readable by its owner only, that redirects a browser to an address.

    Every user of the machine can see the command line that starts a browser. So the browser gets this file in place of
    the address, which contains the token.
    """
    path = folder / "explore.html"
    path.touch(mode=0o600, exist_ok=False)
    path.write_text(f'<!DOCTYPE html><meta http-equiv="refresh" content="0; url={html.escape(url)}">', "utf-8")
    return path
