"""The page, served on this machine."""

import contextlib
import importlib.util
import os
import secrets
import socket
import sys
import threading
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Any

from . import controls
from .diagram import diagram
from .guard import Guard
from .motion import prepare
from .subject import Subject as Subject

NEEDED = "marimo>=0.25"
"""What the page needs beside the library."""


def missing() -> str | None:
    """What to do if the page cannot be served because marimo is not installed, else `None`."""
    if importlib.util.find_spec("marimo") is not None:
        return None
    return f"the page needs marimo, which is not installed: pip install '{NEEDED}'"


def compile_all(tell: Callable[[str], None]) -> None:
    """Compile every program that a slider can need."""
    tell("compiling the ideal drive")
    values = controls.beginning(controls.IDEAL)
    _ = prepare(*controls.ideal(values)).stability
    tell("compiling the diagram")
    name, control = next(iter(controls.NUMBERS.items()))
    numbers = {name: values[name] for name in controls.NUMBERS}
    diagram(numbers, name, (control.low, control.high), Y=values["Y"], V=values["V"])
    tell("compiling the motor")
    prepare(*controls.motor(controls.beginning(controls.MOTOR)))


# What the page of a machine shows: its name and the machine. The page runs on threads of this
# process, and gets nothing but its address.
_SERVED: list[tuple[str, Subject]] = []


def served() -> tuple[str, Subject] | None:
    """The machine that is served beside the ready ones, and its name; `None` if there is none."""
    return _SERVED[-1] if _SERVED else None


def serve(
    host: str,
    port: int,
    *,
    browser: bool,
    tell: Callable[[str], None],
    machine: tuple[str, Subject] | None = None,
    paper: bool = True,
) -> None:
    """Serve the page until Ctrl-C, which ends the process.

    Its address, which is reported, holds a token without which nothing is answered.

    **Arguments:** address and port to listen at (port 0: any that is free); whether to open a
    browser; `tell`, called with lines about the progress; `machine`, the name and the sliders of
    one to show instead of the paper's scene; `paper`, whether that is shown where no machine is
    given, else the ready ones.

    **Raises:** `OSError` if it cannot listen there.
    """
    import marimo  # pyright: ignore[reportMissingImports]
    import uvicorn  # pyright: ignore[reportMissingImports]

    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.create_server((host, port), family=family) as listening:
        if machine is not None:
            machine[1].compile(tell)
            _SERVED.append(machine)
        elif paper:
            compile_all(tell)
        name = f"[{host}]" if ":" in host else host
        port, token = listening.getsockname()[1], secrets.token_urlsafe(16)
        address = f"http://{name}:{port}?access_token={token}"
        app: Any = Guard(_page(marimo, port, token, machine is None and paper), host)
        options = {"log_level": "warning", "timeout_graceful_shutdown": 1}
        server = uvicorn.Server(uvicorn.Config(app, **options))
        tell(f"serving {address} until Ctrl-C")
        if browser:  # it waits until it is answered
            threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()
        with contextlib.suppress(KeyboardInterrupt):
            server.run(sockets=[listening])
    # marimo leaves threads that wait for its pages, for which Python would wait in turn.
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(0)


def _page(marimo: Any, port: int, token: str, paper: bool) -> Any:
    """The page as an ASGI app that answers only requests with the token."""
    page = str(Path(__file__).with_name("page.py" if paper else "machine_page.py"))
    made = marimo.create_asgi_app(quiet=True, token=token, skew_protection=True)
    app = made.with_app(path="", root=page).build()
    # The cookie with the token is named by the port: a browser keeps one cookie of each name for
    # all ports of a host, so that two of these servers would overwrite each other's.
    for mounted in app.routes:
        mounted.app.state.port = port
    return app
