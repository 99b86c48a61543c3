"""`vi-jax explore`: what it says where it cannot serve, and its page in a browser."""

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

import pytest
from vi_jax import cli
from vi_jax.explore import serve

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
        if found := re.search(r"http://\S+:\d+", line):
            break
    else:
        pytest.fail("".join(lines))
    yield found[0]
    os.kill(served.pid, signal.SIGINT)
    assert served.wait(timeout=30) == 0  # Ctrl-C is how it ends
    assert "Traceback" not in served.stderr.read()


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
