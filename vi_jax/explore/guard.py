"""Who may ask the page's server: the browser that has its address, from the page itself.

A page of somebody else that is open in the same browser can send requests to this computer too, and
if it makes a host name point here (DNS rebinding), it can even read the answers. Both kinds of
request are recognised by their headers `Origin` and `Host`.
"""

import ipaddress
from collections.abc import Awaitable, Callable
from typing import Any
from urllib.parse import urlsplit

# ASGI: the request, how to receive more of its body, and how to answer.
Scope = dict[str, Any]
Receive = Callable[[], Awaitable[dict[str, Any]]]
Send = Callable[[dict[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

_LOCAL = {"localhost", "127.0.0.1", "::1"}


class Guard:
    """An ASGI app that passes on only requests that `refusal` does not refuse.

    **Arguments:** the app; the address that it listens at.
    """

    def __init__(self, app: App, host: str):
        self._app, self._host = app, host

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            return await self._app(scope, receive, send)
        headers = {name.decode("latin-1"): x.decode("latin-1") for name, x in scope["headers"]}
        reason = refusal(self._host, headers.get("host", ""), headers.get("origin"))
        if reason is None:
            return await self._app(scope, receive, _unshared(send))
        if scope["type"] == "websocket":
            return await send({"type": "websocket.close", "code": 1008, "reason": reason})
        text = [(b"content-type", b"text/plain; charset=utf-8")]
        await send({"type": "http.response.start", "status": 403, "headers": text})
        await send({"type": "http.response.body", "body": reason.encode()})


def refusal(listening: str, host: str, origin: str | None) -> str | None:
    """Why a request is refused, or `None`.

    **Arguments:** the address that the server listens at; the request's headers `Host` and, if it
    has one, `Origin`.
    """
    if _is_local(listening) and _name_of(host) not in {*_LOCAL, listening}:
        return f"This page is served for this machine only, not for {host!r}."
    if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
        return f"This page answers to itself only, not to {origin!r}."
    return None


def _is_local(listening: str) -> bool:
    try:
        return ipaddress.ip_address(listening).is_loopback
    except ValueError:
        return listening == "localhost"


def _name_of(host: str) -> str | None:
    """The name in `name:port`; of an address of version 6 without its brackets."""
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:
        return None


def _unshared(send: Send) -> Send:
    """`send` without headers that would share the answer with other pages (CORS)."""

    async def without(message: dict[str, Any]) -> None:
        if "headers" in message:
            kept = [
                pair
                for pair in message["headers"]
                if not bytes(pair[0]).lower().startswith(b"access-control-")
            ]
            message = {**message, "headers": kept}
        await send(message)

    return without
