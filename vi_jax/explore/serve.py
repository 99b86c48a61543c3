"""The page, served on this machine by marimo."""

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
"""What the page needs beside the library."""

SERVED: list[tuple[str, Subject]] = []
"""Last the name and the sliders of the machine that the page shows first, which runs on threads of
this process, and gets nothing but its address."""


def missing() -> str | None:
    """What to do if the page cannot be served because marimo is not installed, else `None`."""
    if importlib.util.find_spec("marimo") is not None:
        return None
    return f"the page needs marimo, which is not installed: pip install '{NEEDED}'"


def serve(
    host: str, port: int, machine: tuple[str, Subject], *, browser: bool,
    tell: Callable[[str], None],
) -> None:  # fmt: skip
    """Serve the page until Ctrl-C, which ends the process.

    Its address, which is reported, holds a token without which nothing is answered.

    **Arguments:** address and port to listen at (port 0: any that is free); the machine to show
    first and its name; whether to open a browser; `tell`, called with lines about the progress.

    **Raises:** `OSError` if it cannot listen there.
    """
    import marimo  # pyright: ignore[reportMissingImports]
    import uvicorn  # pyright: ignore[reportMissingImports]

    page = str(Path(__file__).with_name("page.py"))
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.create_server((host, port), family=family) as listening:
        # asyncio sets it only for sockets that it opened; without it an answer waits up to 40 ms.
        listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        machine[1].compile(tell)
        SERVED.append(machine)
        port, token = listening.getsockname()[1], secrets.token_urlsafe(16)
        address = f"http://{f'[{host}]' if ':' in host else host}:{port}?access_token={token}"
        made = marimo.create_asgi_app(quiet=True, token=token, skew_protection=True)
        app: Any = made.with_app(path="", root=page).build()
        # The cookie with the token is named by the port: a browser keeps one cookie of each name
        # for all ports of a host, so that two of these servers would overwrite each other's.
        for mounted in app.routes:
            mounted.app.state.port = port
        options: Any = {"log_level": "warning", "timeout_graceful_shutdown": 1}
        server = uvicorn.Server(uvicorn.Config(guarded(app, host), **options))
        tell(f"serving {address} until Ctrl-C")
        if browser:  # it waits until it is answered
            threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()
        with contextlib.suppress(KeyboardInterrupt):
            server.run(sockets=[listening])
    # marimo leaves threads that wait for its pages, for which Python would wait in turn.
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(0)


def guarded(app: Any, host: str) -> Any:
    """An ASGI app that refuses requests from the pages of others, which a browser may send too: by
    another name of this machine (DNS rebinding), or with another origin.

    **Arguments:** the app; the address that it listens at.
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
