"""The server of the page on this machine, by marimo."""

import contextlib
import importlib.util
import ipaddress
import os
import secrets
import socket
import sys
import threading
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from .subject import Subject as Subject

NEEDED = "marimo>=0.25"
"""The additional package that the page needs."""

SERVED: list[tuple[str, Subject]] = []
"""The last entry is the name and the sliders of the page's first machine. The page runs on threads
of this process and receives only its address."""


def missing() -> str | None:
    """Return advice if marimo, which serves the page, is not installed, else `None`."""
    if importlib.util.find_spec("marimo") is not None:
        return None
    return f"the page needs marimo, which is not installed: pip install '{NEEDED}'"


def serve(
    host: str, port: int, machine: tuple[str, Subject], *, browser: bool,
    report: Callable[[str], None],
) -> None:  # fmt: skip
    """Serve the page until Ctrl-C, which ends the process.

    The reported address contains a token, which every request needs.

    **Arguments:** `host` and `port`, the address (port 0: any free one); `machine`, the first
    machine and its name; `browser`, whether to open one; `report`, called with lines of progress.

    **Raises:** `OSError` if the address is not available.
    """
    import marimo  # pyright: ignore[reportMissingImports]
    import uvicorn  # pyright: ignore[reportMissingImports]

    page = str(Path(__file__).with_name("page.py"))
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.create_server((host, port), family=family) as listening:
        # asyncio sets it only for its own sockets; without it a response waits up to 40 ms.
        listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        machine[1].compile(report)
        SERVED.append(machine)
        port, token = listening.getsockname()[1], secrets.token_urlsafe(16)
        address = f"http://{f'[{host}]' if ':' in host else host}:{port}?access_token={token}"
        builder = marimo.create_asgi_app(quiet=True, token=token, skew_protection=True)
        app: Any = builder.with_app(path="", root=page).build()
        # The port is part of the cookie's name. A browser keeps one cookie of each name for all
        # ports of a host, so that two servers would overwrite each other's.
        for mounted in app.routes:
            mounted.app.state.port = port
        options: Any = {"log_level": "warning", "timeout_graceful_shutdown": 1}
        server = uvicorn.Server(uvicorn.Config(guarded(app, host), **options))
        report(f"serving {address} until Ctrl-C")
        if browser:  # it waits for the response
            threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()
        with contextlib.suppress(KeyboardInterrupt):
            server.run(sockets=[listening])
    # Threads of marimo still wait for pages, and Python would wait for them.
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(0)


def guarded(app: Any, host: str) -> Any:
    """Return an ASGI app that refuses requests from other pages, by another name of this machine
    (DNS rebinding) or with another origin.

    **Arguments:** `app`; `host`, the address on which it listens.
    """
    from starlette import datastructures, responses, websockets  # pyright: ignore
    from starlette.middleware import trustedhost  # pyright: ignore

    async def own_origin(scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] in ("http", "websocket"):
            headers = datastructures.Headers(scope=scope)
            origin = headers.get("origin")
            if origin is not None and urlsplit(origin).netloc != headers.get("host"):
                refusal: Any = responses.PlainTextResponse("this page answers to itself only", 403)
                if scope["type"] == "websocket":
                    refusal = websockets.WebSocketClose(1008)
                return await refusal(scope, receive, send)
        return await app(scope, receive, send)

    local = host == "localhost"
    with contextlib.suppress(ValueError):
        local = ipaddress.ip_address(host).is_loopback
    names = [host, "localhost", "127.0.0.1", "::1", "[::1]"] if local else ["*"]
    return trustedhost.TrustedHostMiddleware(own_origin, allowed_hosts=names, www_redirect=False)
