"""`vi-jax explore`: error messages, access control, and its page in a browser."""

import asyncio
import http.client
import importlib.util
import os
import re
import signal
import socket
import subprocess
import sys
import tomllib
from pathlib import Path
from urllib.parse import urlsplit

import pytest
import vi_jax as vi
from vi_jax import cli
from vi_jax.explore import serve
from vi_jax.explore.subject import Subject

ROOT = Path(__file__).parents[2]


def test_without_marimo_the_message_names_the_extra(monkeypatch, capsys):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert cli.main(["explore", "--no-browser"]) == 1
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1 and f"pip install '{serve.NEEDED}'" in printed
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert extras["optional-dependencies"]["explore"] == [serve.NEEDED]


OWN = "import vi_jax as vi\n\nmake = vi.machines.Duffing\n"


@pytest.mark.parametrize(
    ("name", "more", "message"),
    [
        ("no.such:make", [], "no.such:make raised ModuleNotFoundError: No module named 'no'"),
        ("shown.py:make", ["--range", "gap", "1", "x"], "could not convert string to float: 'x'"),
        ("shown.py:make", ["--range", "gap", "2", "1"], "two finite numbers (low, high), low < hi"),
        ("shown.py:make", ["--range", "gab", "1", "2"], "is of 'gab'"),
    ],
)
def test_invalid_machines_and_ranges_are_errors_before_serving(
    name, more, message, tmp_path, monkeypatch, capsys
):
    (tmp_path / "shown.py").write_text(OWN, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "shown", raising=False)
    monkeypatch.setattr("vi_jax.cli.command.missing", lambda: None)
    called = []
    monkeypatch.setattr("vi_jax.cli.command.serve", lambda *a, **k: called.append(a))
    assert cli.main(["explore", "--no-browser", "--machine", name, *more]) == 2
    printed = capsys.readouterr().err
    assert message in printed and printed.count("\n") == 1 and not called
    assert cli.main(["explore", "--range", "gap", "0.5", "3"]) == 2 and not called
    assert "--range: only with --machine" in capsys.readouterr().err
    more = ["--machine", "shown.py:make", "--range", "gap", "0.5", "3"]
    assert cli.main(["explore", *more]) == 0
    shown, subject = called[0][2]
    assert shown == "shown.py:make" and isinstance(subject.machine, vi.machines.Duffing)
    assert (subject.controls["gap"].low, subject.controls["gap"].high) == (0.5, 3.0)


def test_invalid_or_used_ports_are_errors(monkeypatch, capsys):
    assert cli.main(["explore", "--port", "70000"]) == 2
    assert "port must be 0-65535" in capsys.readouterr().err
    pytest.importorskip("marimo")
    monkeypatch.setattr(Subject, "compile", lambda self, tell: pytest.fail("work began"))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert cli.main(["explore", "--no-browser", "--port", str(port)]) == 1
    assert f"port {port}" in capsys.readouterr().err


@pytest.fixture(scope="module")
def address():
    """Start the command and yield the address of its page."""
    pytest.importorskip("marimo")
    command = [sys.executable, "-m", "vi_jax", "explore", "--no-browser", "--port", "0"]
    served = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert served.stderr is not None
    lines = []
    for line in served.stderr:
        lines.append(line)
        if found := re.search(r"http://\S+:\d+\?access_token=\S{20,}", line):
            break
    else:
        pytest.fail("".join(lines))
    yield found[0]
    os.kill(served.pid, signal.SIGINT)
    assert served.wait(timeout=30) == 0  # Ctrl-C is the normal end
    assert "Traceback" not in served.stderr.read()


PAGE = "127.0.0.1:8417"


@pytest.mark.parametrize("kind", ["http", "websocket"])
@pytest.mark.parametrize(
    ("listening", "host", "origin", "good"),
    [
        ("127.0.0.1", PAGE, None, True),
        ("127.0.0.1", "localhost:8417", "http://localhost:8417", True),
        ("0.0.0.0", "machine.lab:8417", "http://machine.lab:8417", True),
        ("127.0.0.1", PAGE, "http://evil.example", False),
        ("0.0.0.0", "machine.lab:8417", "http://evil.example", False),
        ("127.0.0.1", "evil.example:8417", "http://evil.example:8417", False),
        ("localhost", "127.0.0.1.evil.example", None, False),
    ],
)
def test_only_requests_from_the_page_are_answered(kind, listening, host, origin, good):
    pytest.importorskip("starlette")
    asked, answered = [], []

    async def app(scope, receive, send):
        asked.append(scope)

    async def send(message):
        answered.append(message)

    headers = [(b"host", host.encode())] + [(b"origin", str(origin).encode())] * bool(origin)
    scope = {"type": kind, "headers": headers, "path": "/", "scheme": "http", "query_string": b"",
             "extensions": {"websocket.http.response": {}}}  # fmt: skip
    asyncio.run(serve.guarded(app, listening)(scope, None, send))
    if good:
        assert asked and not answered
    else:
        first = answered[0]
        assert not asked
        assert first.get("status") in (400, 403) or first["type"] == "websocket.close"


@pytest.mark.slow
def test_requests_without_the_token_are_rejected(address):
    place = urlsplit(address)

    def asked(path, **headers):
        link = http.client.HTTPConnection(place.hostname, place.port, timeout=30)
        link.request("GET", path, headers=headers)
        return link.getresponse()

    for path in ("/", "/?access_token=wrong", "/api/status"):
        answer = asked(path)
        assert answer.status == 401 or "/auth/login" in answer.headers["location"]
    cookie = asked(f"/?{place.query}").headers["set-cookie"].partition(";")[0]
    assert cookie.startswith(f"session_{place.port}=")
    good = asked("/", Cookie=cookie, Origin=f"http://{place.netloc}")
    assert good.status == 200 and b"vi_jax" in good.read()
    assert asked("/", Cookie=cookie, Origin="http://evil.example").status == 403
    assert asked("/", Cookie=cookie, Host=f"evil.example:{place.port}").status == 400
    client = pytest.importorskip("websockets.sync.client")
    socket_at = f"ws://{place.netloc}/ws?session_id=s_tried1"
    for headers, origin in (({}, None), ({"Cookie": cookie}, "http://evil.example")):
        with pytest.raises(Exception, match="HTTP 403"):
            client.connect(socket_at, additional_headers=headers, origin=origin)
    own = {"additional_headers": {"Cookie": cookie}, "origin": f"http://{place.netloc}"}
    with client.connect(socket_at, **own) as opened:
        assert "kernel-ready" in opened.recv(timeout=60)
