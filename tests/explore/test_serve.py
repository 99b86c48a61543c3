"""`vi-jax explore`: what it says where it cannot serve, and its page in a browser."""

import asyncio
import http.client
import importlib.util
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tomllib
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from vi_jax import cli
from vi_jax.explore import controls, guard, serve

ROOT = Path(__file__).parents[2]


def test_without_marimo_it_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert cli.main(["explore", "--no-browser"]) == 1
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1 and f"pip install '{serve.NEEDED}'" in printed
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert extras["optional-dependencies"]["explore"] == [serve.NEEDED]


def test_a_port_that_is_none(capsys):
    assert cli.main(["explore", "--port", "70000"]) == 2
    assert "--port" in capsys.readouterr().err


def test_a_port_that_is_taken(monkeypatch, capsys):
    pytest.importorskip("marimo")
    monkeypatch.setattr(serve, "compile_all", lambda tell: pytest.fail("work began"))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert cli.main(["explore", "--no-browser", "--port", str(port)]) == 1
    assert f"port {port}" in capsys.readouterr().err


@pytest.fixture(scope="module")
def address():
    """The page, served by the command."""
    pytest.importorskip("marimo")
    command = [sys.executable, "-m", "vi_jax.cli", "explore", "--no-browser", "--port", "0"]
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
    assert served.wait(timeout=30) == 0  # Ctrl-C is how it ends
    assert "Traceback" not in served.stderr.read()


PAGE = "127.0.0.1:8417"


@pytest.mark.parametrize(
    ("listening", "host", "origin", "message"),
    [
        ("127.0.0.1", PAGE, None, None),
        ("127.0.0.1", "localhost:8417", "http://localhost:8417", None),
        ("::1", "[::1]:8417", "http://[::1]:8417", None),
        ("127.0.0.5", "127.0.0.5:8417", None, None),
        ("0.0.0.0", "machine.lab:8417", "http://machine.lab:8417", None),
        ("127.0.0.1", PAGE, "http://evil.example", "to itself only, not to 'http://evil"),
        ("127.0.0.1", PAGE, "http://127.0.0.1:8888", "to itself only"),  # another port is another
        ("127.0.0.1", PAGE, "null", "to itself only"),
        ("0.0.0.0", "machine.lab:8417", "http://evil.example", "to itself only"),
        ("127.0.0.1", "evil.example:8417", "http://evil.example:8417", "for this machine only"),
        ("localhost", "127.0.0.1.evil.example", None, "for this machine only"),
        ("127.0.0.1", "", None, "for this machine only"),
        ("127.0.0.1", "[::1", None, "for this machine only"),
    ],
)
def test_who_is_answered(listening, host, origin, message):
    reason = guard.refusal(listening, host, origin)
    assert reason is None if message is None else message in str(reason)


@pytest.mark.parametrize("kind", ["http", "websocket"])
@pytest.mark.parametrize("origin", [f"http://{PAGE}", "http://evil.example"])
def test_a_guarded_app_is_asked_by_its_own_page_only(kind, origin):
    asked, answered = [], []

    async def app(scope, receive, send):
        asked.append(scope)
        shared = [(b"Access-Control-Allow-Origin", b"*"), (b"content-type", b"text/html")]
        await send({"type": "http.response.start", "status": 200, "headers": shared})

    async def send(message):
        answered.append(message)

    scope = {"type": kind, "headers": [(b"host", PAGE.encode()), (b"origin", origin.encode())]}
    asyncio.run(guard.Guard(app, "127.0.0.1")(scope, None, send))  # pyright: ignore
    if "evil" in origin:
        assert not asked
        assert answered[0].get("status") == 403 or answered[0]["type"] == "websocket.close"
    else:
        assert asked and answered[0]["headers"] == [(b"content-type", b"text/html")]


def test_values_that_no_slider_has_are_refused_in_a_sentence():
    values = controls.beginning(controls.IDEAL)
    assert controls.fault(controls.IDEAL, values) is None
    assert controls.fault(controls.MOTOR, controls.beginning(controls.MOTOR)) is None
    for wrong in (1e9, -5.0, float("nan"), None, "0.9"):
        message = controls.fault(controls.IDEAL, {**values, "settle": wrong})
        assert message == f"The cycles before must be a number from 0 to 2000, but is {wrong!r}."
    for control in controls.IDEAL.values():
        ends = (control.nearest(1e9), control.nearest(-1e9), control.nearest(float("nan")))
        assert all(control.holds(value) for value in ends)


@pytest.mark.slow
def test_nobody_without_the_token_is_answered(address):
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
    assert "access-control-allow-origin" not in good.headers
    assert asked("/", Cookie=cookie, Origin="http://evil.example").status == 403
    assert asked("/", Cookie=cookie, Host=f"evil.example:{place.port}").status == 403
    client = pytest.importorskip("websockets.sync.client")
    socket_at = f"ws://{place.netloc}/ws?session_id=s_tried1"
    for headers, origin in (({}, None), ({"Cookie": cookie}, "http://evil.example")):
        with pytest.raises(Exception, match="HTTP 403"):
            client.connect(socket_at, additional_headers=headers, origin=origin)
    own = {"additional_headers": {"Cookie": cookie}, "origin": f"http://{place.netloc}"}
    with client.connect(socket_at, **own) as opened:
        assert "kernel-ready" in opened.recv(timeout=60)


@pytest.fixture
def page(address):
    """The page in a browser without a window."""
    playwright = pytest.importorskip("playwright.sync_api")
    own = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), None)
    with playwright.sync_playwright() as tools:
        try:
            browser = tools.chromium.launch(executable_path=own, args=["--no-sandbox"])
        except playwright.Error as error:
            pytest.skip(f"no Chromium can be started: {str(error).splitlines()[0]}")
        page = browser.new_page(viewport={"width": 1400, "height": 1000})
        page.set_default_timeout(60_000)
        faults = []
        page.on("pageerror", lambda error: faults.append(error))
        page.goto(address)
        page.wait_for_selector("#motion")
        yield page
        browser.close()
        assert not faults


def after(page, act) -> str:
    """The regime after the picture has changed."""
    before = page.get_attribute("#motion", "src")
    act()
    page.wait_for_function(
        "old => document.querySelector('#motion') && document.querySelector('#motion').src != old",
        arg=before,
    )
    return page.inner_text("#regime")


@pytest.mark.slow
def test_a_slider_redraws(page):
    assert page.inner_text("#regime").startswith("period 4π with 1 impact")
    slider = page.get_by_role("slider").first
    assert slider.get_attribute("aria-valuenow") == "0.9"
    after(page, lambda: slider.press("ArrowRight"))
    assert slider.get_attribute("aria-valuenow") == "0.902"
    assert "period 2π" in after(page, lambda: slider.press("End"))


@pytest.mark.slow
def test_a_click_in_the_diagram_shows_that_motion(page):
    page.get_by_role("tab", name="Bifurcations").click()
    canvas = page.locator("marimo-matplotlib canvas").last
    box = canvas.bounding_box()
    middle = {"x": 0.525 * box["width"], "y": 0.5 * box["height"]}  # of the axes, 6.5 % to 98.5 %
    assert "period 2π" in after(page, lambda: canvas.click(position=middle))
    slider = page.get_by_role("slider").first
    assert float(slider.get_attribute("aria-valuenow")) == pytest.approx(1.4, abs=0.01)


@pytest.mark.slow
def test_a_motor(page):
    regime = after(page, page.get_by_role("tab", name="Motor").click)
    assert "multipliers" in regime
