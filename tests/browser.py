"""A browser without a window, driven over a pipe by the DevTools protocol: what a person does with a page."""

from __future__ import annotations

import base64
import io
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

NAMES = ("chromium-headless-shell", "chromium", "google-chrome")
# WebGL without a graphics card; a container has little shared memory and no sandbox
OPTIONS = (
    "--headless", "--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--hide-scrollbars", "--force-color-profile=srgb", "--remote-debugging-pipe", "--no-first-run",
)  # fmt: skip
Pixels = NDArray[np.uint8]


def browser_path() -> str | None:
    """Where a browser is; None where there is none."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class PageError(Exception):
    """What the page or the browser says is wrong."""


class Browser:
    """One browser, with one page at a time.

    Parameters
    ----------
    options
        Further ones of its command line.

    Attributes
    ----------
    said
        Console messages from warnings on, and exceptions, since the last `open`.
    requests
        Addresses that were asked for since then.
    """

    def __init__(self, *options: str):
        path = browser_path()
        assert path is not None
        self._profile = tempfile.TemporaryDirectory(
            prefix="remodel-fenicsx-browser-", ignore_cleanup_errors=True
        )
        to_read, self._write = os.pipe()
        self._read, to_write = os.pipe()
        command = [
            "bash",
            "-c",
            f'exec "$@" 3<&{to_read} 4>&{to_write}',
            "bash",
            path,
            *OPTIONS,
            *options,
        ]
        command += [f"--user-data-dir={self._profile.name}", "about:blank"]
        self.process = subprocess.Popen(
            command, pass_fds=(to_read, to_write), stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(to_read)
        os.close(to_write)
        self._number, self._session, self._buffer = 0, "", b""
        self.said: list[str] = []
        self.requests: list[str] = []
        targets = self.call("Target.getTargets")["targetInfos"]
        target = next(one["targetId"] for one in targets if one["type"] == "page")
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)[
            "sessionId"
        ]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """A command of the protocol, and its answer; what the page says meanwhile is kept."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next(60.0)
            if answer.get("id") != self._number:
                continue
            if "error" in answer:
                raise PageError(f"{method}: {answer['error']['message']}")
            return dict(answer["result"])

    def _next(self, seconds: float) -> dict[str, Any]:
        deadline = time.monotonic() + seconds
        while b"\0" not in self._buffer:
            if not select.select([self._read], [], [], max(0.0, deadline - time.monotonic()))[0]:
                raise PageError("the browser does not answer")
            data = os.read(self._read, 1 << 20)
            if not data:
                raise PageError("the browser has ended")
            self._buffer += data
        text, _, self._buffer = self._buffer.partition(b"\0")
        message: dict[str, Any] = json.loads(text)
        self._note(message.get("method", ""), message.get("params", {}))
        return message

    def _note(self, method: str, found: dict[str, Any]) -> None:
        if method == "Runtime.consoleAPICalled" and found["type"] in ("warning", "error", "assert"):
            self.said.append(
                " ".join(str(one.get("value", one.get("description"))) for one in found["args"])
            )
        elif method == "Runtime.exceptionThrown":
            details = found["exceptionDetails"]
            self.said.append(details.get("exception", {}).get("description", details["text"]))
        elif method == "Log.entryAdded" and found["entry"]["level"] in ("warning", "error"):
            self.said.append(found["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.requests.append(found["request"]["url"])

    # ------------------------------------------------------------ what a person does
    def open(
        self, page: Path, width: int = 1360, height: int = 1000, wait: bool = True, **media: str
    ) -> None:
        """Open a file and wait until it says that it is ready; media features as prefers_color_scheme="dark"."""
        features = [
            {"name": name.replace("_", "-"), "value": value}
            for name, value in media.items()
            if name != "type"
        ]
        self.call("Emulation.setEmulatedMedia", features=features, media=media.get("type", ""))
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        self.call("Page.navigate", url="about:blank")
        self.said, self.requests = [], []
        self.call("Page.navigate", url=page.as_uri())
        if wait:
            self.wait_for("document.documentElement?.dataset.ready === 'yes'")

    def wait_for(self, condition: str, seconds: float = 20.0) -> None:
        """Until an expression of the page is true."""
        deadline = time.monotonic() + seconds
        while not self.value(condition):
            if time.monotonic() > deadline:
                raise PageError(f"not within {seconds} s: {condition}; the page said {self.said}")
            time.sleep(0.02)

    def wait_until(self, is_so: Callable[[], bool], seconds: float = 20.0) -> None:
        """Until something outside of the page is so; the browser is asked meanwhile, so that it goes on."""
        deadline = time.monotonic() + seconds
        while not is_so():
            if time.monotonic() > deadline:
                raise PageError(f"not within {seconds} s")
            self.value("1")
            time.sleep(0.02)

    def value(self, expression: str) -> Any:
        """Of an expression of the page; promises are waited for."""
        found = self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        if "exceptionDetails" in found:
            raise PageError(found["exceptionDetails"]["exception"]["description"])
        return found["result"].get("value")

    def place(self, selector: str) -> tuple[float, float, float, float]:
        """Left, top, width and height of an element, which is scrolled into view."""
        script = "(e => { e.scrollIntoView({block: 'center'}); const b = e.getBoundingClientRect();"
        x, y, width, height = self.value(
            f"{script} return [b.x, b.y, b.width, b.height]; }})(document.querySelector('{selector}'))"
        )
        return x, y, width, height

    def click(self, selector: str, across: float = 0.5, down: float = 0.5) -> None:
        """On a place of an element, as shares of its size."""
        x, y, width, height = self.place(selector)
        self.drag((x + across * width, y + down * height))

    def drag(self, *places: tuple[float, float]) -> None:
        """The left button down at the first place, up at the last."""
        for kind, (x, y) in zip(
            ["mousePressed", *["mouseMoved"] * (len(places) - 1), "mouseReleased"],
            [*places, places[-1]],
            strict=True,
        ):
            buttons = 0 if kind == "mouseReleased" else 1
            self.call(
                "Input.dispatchMouseEvent",
                type=kind,
                x=x,
                y=y,
                button="left",
                buttons=buttons,
                clickCount=1,
            )

    def press(self, key: str) -> None:
        """A key, where the focus is."""
        codes = {"ArrowLeft": 37, "ArrowRight": 39, "Home": 36, "End": 35, " ": 32, "Tab": 9}
        for kind in ("rawKeyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent",
                type=kind,
                key=key,
                code=key,
                windowsVirtualKeyCode=codes[key],
            )

    def choose(self, selector: str, value: str) -> None:
        """A choice of a list."""
        self.value(
            f"(e => {{ e.value = '{value}'; e.dispatchEvent(new Event('change', {{bubbles: true}})); }})"
            f"(document.querySelector('{selector}'))"
        )

    def screenshot(self, selector: str | None = None) -> Pixels:
        """(rows, columns, 3) of an element, or of the whole page."""
        options: dict[str, Any] = {"captureBeyondViewport": True}
        if selector is not None:
            x, y, width, height = self.place(selector)
            scrolled = self.value("window.scrollY")
            options["clip"] = {
                "x": x,
                "y": y + scrolled,
                "width": width,
                "height": height,
                "scale": 1,
            }
        else:
            size = self.call("Page.getLayoutMetrics")["cssContentSize"]
            options["clip"] = {
                "x": 0,
                "y": 0,
                "width": size["width"],
                "height": size["height"],
                "scale": 1,
            }
        data = base64.b64decode(
            self.call("Page.captureScreenshot", format="png", **options)["data"]
        )
        with Image.open(io.BytesIO(data)) as picture:
            return np.asarray(picture.convert("RGB"))

    def close(self) -> None:
        """End it."""
        os.close(self._write)
        try:
            self.process.wait(5)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        os.close(self._read)
        self._profile.cleanup()

    def __enter__(self) -> Browser:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
