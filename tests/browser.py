"""A headless browser for tests: Chromium through its own driver, by the WebDriver protocol over HTTP."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import shutil
import socket
import subprocess
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

DRIVER = os.environ.get("OPTSIM_CHROMEDRIVER") or shutil.which("chromedriver")
CHROMIUM = os.environ.get("OPTSIM_CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
MISSING = (
    ""
    if DRIVER and CHROMIUM
    else "no browser: needs chromium and chromedriver on the PATH (Debian: chromium, chromium-driver)"
)
_START_S = 20.0


class Browser:
    """One window; ``execute`` runs JavaScript in the page, ``keys`` and ``drag`` act as a person does."""

    def __init__(self, address: str, profile: str) -> None:
        self._address = address
        arguments = ["--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={profile}"]
        wanted = {
            "browserName": "chrome",
            "goog:loggingPrefs": {"browser": "ALL"},
            "goog:chromeOptions": {"binary": CHROMIUM, "args": [*arguments, "--hide-scrollbars"]},
        }
        session = self._send("POST", "/session", {"capabilities": {"alwaysMatch": wanted}})
        self._path = f"/session/{session['sessionId']}"

    def _send(self, method: str, path: str, body: object = None) -> Any:
        text = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self._address + path, text, method=method)
        try:
            with urllib.request.urlopen(request, timeout=60) as answer:
                return json.loads(answer.read())["value"]
        except urllib.error.HTTPError as error:
            raise AssertionError(json.loads(error.read())["value"]["message"]) from None

    def size(self, width: int, height: int, *, dark: bool = False) -> None:
        """Set what the page sees, in CSS pixels, as a telephone of that width would."""
        about = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        self.devtools("Emulation.setDeviceMetricsOverride", about)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.devtools("Emulation.setEmulatedMedia", {"features": [scheme]})

    def devtools(self, command: str, parameters: object) -> Any:
        """Run a command of the browser's developer tools."""
        return self._send("POST", f"{self._path}/goog/cdp/execute", {"cmd": command, "params": parameters})

    def open(self, page: Path) -> None:
        """Open a file, as from disk."""
        self._send("POST", f"{self._path}/url", {"url": page.resolve().as_uri()})

    def execute(self, script: str) -> Any:
        """Run the body of a function; promises are awaited."""
        body = {"script": f"return (async () => {{ {script} }})()", "args": []}
        return self._send("POST", f"{self._path}/execute/sync", body)

    def keys(self, text: str) -> None:
        """Press keys one by one, where the focus is."""
        actions = [{"type": kind, "value": key} for key in text for kind in ("keyDown", "keyUp")]
        self._act({"type": "key", "id": "keyboard", "actions": actions})

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Press the mouse at one place of the window and release it at another."""
        moves = [
            {"type": "pointerMove", "duration": 50, "x": round(x), "y": round(y)} for x, y in (start, end)
        ]
        down, up = ({"type": kind, "button": 0} for kind in ("pointerDown", "pointerUp"))
        self._act({"type": "pointer", "id": "mouse", "actions": [moves[0], down, moves[1], up]})

    def _act(self, action: object) -> None:
        self._send("POST", f"{self._path}/actions", {"actions": [action]})

    def errors(self) -> list[str]:
        """Messages of the console since the last call, of warnings and errors."""
        entries = self._send("POST", f"{self._path}/se/log", {"type": "browser"})
        return [entry["message"] for entry in entries if entry["level"] in ("WARNING", "SEVERE")]

    def screenshot(self, path: Path) -> None:
        """Save what the window shows."""
        path.write_bytes(base64.b64decode(self._send("GET", f"{self._path}/screenshot")))

    def close(self) -> None:
        """End the session and its window."""
        self._send("DELETE", self._path)


@contextlib.contextmanager
def browser() -> Iterator[Browser]:
    """Yield a browser of its own, closed at the end."""
    assert DRIVER
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        driver = subprocess.Popen([DRIVER, f"--port={port}"], stdout=subprocess.DEVNULL)
        try:
            _wait_for(port)
            window = Browser(f"http://127.0.0.1:{port}", profile)
            try:
                yield window
            finally:
                window.close()
        finally:
            driver.terminate()
            driver.wait()


def _wait_for(port: int) -> None:
    until = time.monotonic() + _START_S
    while time.monotonic() < until:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
            return
        time.sleep(0.05)
    raise AssertionError("chromedriver does not answer")
