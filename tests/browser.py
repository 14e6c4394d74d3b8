"""A real browser without a display, driven by its DevTools protocol: what a page looks like to people."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
import subprocess
import time
import urllib.request
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

PROGRAM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
_FLAGS = (
    "--headless=new",
    "--no-sandbox",  # CI runs as root
    "--disable-dev-shm-usage",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",  # WebGL without a GPU
    "--hide-scrollbars",
    "--remote-debugging-port=0",
)
_LONG_S = 300.0
"""A machine may be busy; what is waited for comes in a second or two."""


class Browser:
    """Chromium with one page."""

    def __init__(self, profile: Path, *, size: tuple[int, int] = (960, 640)) -> None:
        from websockets.sync.client import connect  # viser brings it along

        assert PROGRAM is not None
        command = [PROGRAM, *_FLAGS, f"--user-data-dir={profile}", "about:blank"]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        assert self._process.stderr is not None
        found = (re.search(r"DevTools listening on ws://([^/]+)/", line) for line in self._process.stderr)
        self._address = next(match[1] for match in found if match)
        pages: list[dict[str, str]] = []
        end = time.monotonic() + _LONG_S
        while not pages:  # it listens before it has one
            assert time.monotonic() < end, "the browser has no page"
            there = json.load(urllib.request.urlopen(f"http://{self._address}/json", timeout=_LONG_S))
            pages = [one for one in there if one["type"] == "page"]
        self._socket = connect(pages[0]["webSocketDebuggerUrl"], max_size=None, open_timeout=_LONG_S)
        self._number = 0
        self.errors: list[str] = []
        """What the page has thrown, and what it couldn't load."""
        for domain in ("Page", "Runtime", "Log", "Network"):
            self._call(f"{domain}.enable")
        self.resize(size)

    def close(self) -> None:
        """Ends it."""
        self._socket.close()
        self._process.kill()  # it would tidy up for seconds, and its profile is thrown away
        self._process.wait(timeout=_LONG_S)
        assert self._process.stderr is not None
        self._process.stderr.close()

    def resize(self, size: tuple[int, int], *, dark: bool = False) -> None:
        """The window [pixels], and what colours its owner likes."""
        width, height = self._size = size
        self._call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 500
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self._call("Emulation.setEmulatedMedia", features=[scheme])

    def offline(self) -> None:
        """From now on there is no network; files are there."""
        self._call(
            "Network.emulateNetworkConditions", offline=True, latency=0, downloadThroughput=-1, uploadThroughput=-1
        )

    def open(self, url: str) -> None:
        """Goes there; returns when the page is loaded, in a window of the size that it had."""
        self._call("Page.navigate", url=url)
        self.resize(self._size)  # another site may be another process, which doesn't know it
        end = time.monotonic() + _LONG_S
        while self.run("document.readyState") != "complete" and time.monotonic() < end:
            time.sleep(0.1)

    def run(self, script: str) -> Any:
        """The value of an expression in the page."""
        return self._call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def drag(self, start: tuple[int, int], by: tuple[int, int]) -> None:
        """The mouse, with its left button down."""
        x, y = start
        mouse = {"button": "left", "buttons": 1, "clickCount": 1}
        self._call("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, **mouse)
        for k in range(1, 6):
            at = {"x": x + by[0] * k / 5, "y": y + by[1] * k / 5}
            self._call("Input.dispatchMouseEvent", type="mouseMoved", **at, **mouse)
        self._call("Input.dispatchMouseEvent", type="mouseReleased", x=x + by[0], y=y + by[1], **mouse)

    def picture(self, *, whole: bool = False) -> NDArray[np.uint8]:
        """What is seen, shape (height, width, 3); with `whole`, down to the end of the page."""
        data = self._call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)["data"]
        return np.array(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))

    def picture_when(self, is_there: Callable[[NDArray[np.uint8]], bool]) -> NDArray[np.uint8]:
        """What is seen as soon as it is what was waited for, or in the end."""
        end = time.monotonic() + _LONG_S
        while True:
            seen = self.picture()
            if is_there(seen) or time.monotonic() > end:
                return seen
            time.sleep(0.3)

    def _call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=_LONG_S))
            if answer.get("method") == "Runtime.exceptionThrown":
                self.errors.append(json.dumps(answer["params"])[:500])
            if answer.get("method") == "Log.entryAdded" and answer["params"]["entry"]["level"] == "error":
                self.errors.append(json.dumps(answer["params"])[:500])
            if answer.get("id") == self._number:
                assert "error" not in answer, answer["error"]
                result: dict[str, Any] = answer["result"]
                return result
