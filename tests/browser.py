"""A real Chromium for the tests, driven in its DevTools protocol."""

import base64
import json
import re
import shutil
import subprocess
import urllib.request
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import websocket
from drive_process import awaited

AXE = Path(__file__).with_name("axe.min.js")  # axe-core 4.14.1 by Deque Systems, MPL-2.0: see axe.LICENSE
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome") or ""
needs_chromium = pytest.mark.skipif(not CHROMIUM, reason="no Chromium here")
LOOKS = [(390, True), (1280, False), (2200, True)]  # widths in px, and whether the system's colours are dark
OPTIONS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update", "--remote-debugging-port=0"),
    "--remote-debugging-pipe",  # which ends with the tests, also if they are killed, and the browser with it
)


class Page:
    """A page in Chromium: one tab."""

    until = staticmethod(awaited)

    def __init__(self, profile: Path):
        piped, null = ["bash", "-c", 'exec "$0" "$@" 3<&0 4>&1'], subprocess.DEVNULL
        command = [*piped, CHROMIUM, *OPTIONS, f"--user-data-dir={profile}", "about:blank"]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=null, stderr=null)
        written = profile / "DevToolsActivePort"
        port = self.until(lambda: written.exists() and written.read_text(encoding="utf-8")).split()[0]

        def tabs() -> list[str]:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=60) as listed:
                return [each["webSocketDebuggerUrl"] for each in json.load(listed) if each["type"] == "page"]

        self.socket = websocket.create_connection(self.until(tabs)[0], timeout=60, suppress_origin=True)
        self.number = 0
        self.events: list[dict] = []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")
        sooner = "const later = setTimeout; setTimeout = (action, ms, ...more) => later(action, ms / 10, ...more)"
        self.send("Page.addScriptToEvaluateOnNewDocument", source=sooner)  # what a page waits for comes sooner

    def send(self, method: str, **parameters) -> dict:
        self.number += 1
        self.socket.send(json.dumps({"id": self.number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self.socket.recv())
            if answer.get("id") == self.number:
                assert "error" not in answer, answer
                return answer["result"]
            self.events.append(answer)

    def run(self, code: str) -> Any:
        """Evaluate JavaScript, await it, and return its value."""
        done = self.send("Runtime.evaluate", expression=code, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in done, done
        return done["result"].get("value")

    def wait(self, code: str) -> None:
        """Wait until a JavaScript expression is true."""
        try:
            self.until(lambda: self.run(f"Boolean({code})"))
        except AssertionError as error:
            raise AssertionError(f"{code}: {error}; the page shows: {self.run('document.body.innerText')}") from None

    def open(self, address: str) -> None:
        """Load a page anew; what an earlier one asked for and said is forgotten."""
        self.empty()
        self.events.clear()
        self.send("Page.navigate", url=address)

    def empty(self) -> None:
        self.send("Page.navigate", url="about:blank")
        self.wait("location.href == 'about:blank' && document.readyState == 'complete'")

    def text(self, selector: str = "body") -> str:
        return self.run(f"document.querySelector({selector!r}).innerText")

    def shows(self, selector: str, words: str) -> None:
        """Wait until an element's text contains these words."""
        self.wait(f"document.querySelector({selector!r})?.textContent.includes({words!r})")

    def click(self, selector: str) -> None:
        self.run(f"document.querySelector({selector!r}).click()")

    def press(self, *keys: str, shift: bool = False) -> None:
        """Press and release keys one after the other, by their names in JavaScript."""
        codes = {"Enter": 13, "Escape": 27, " ": 32, "Tab": 9, "ArrowLeft": 37, "ArrowRight": 39}
        for key in keys:
            character = {"text": "\r" if key == "Enter" else key} if len(key) == 1 or key == "Enter" else {}
            code = {"windowsVirtualKeyCode": codes[key]} if key in codes else {}
            both = {"key": key, "modifiers": 8 * shift, **code}
            self.send("Input.dispatchKeyEvent", type="keyDown", **both, **character)
            self.send("Input.dispatchKeyEvent", type="keyUp", **both)

    def box(self, selector: str) -> tuple[float, float, float, float]:
        """An element's left edge, top, width and height in the window, in px."""
        box = f"document.querySelector({selector!r}).getBoundingClientRect()"
        return self.run(f"(({{x, y, width, height}}) => [x, y, width, height])({box})")

    def drag(self, selector: str, begin: float, end: float, height: float = 0.5, button: str = "left") -> None:
        """Drag the mouse over an element; begin, end, height: shares of its width and height; button: or "right"."""
        left, top, width, tall = self.box(selector)
        kinds, shares = ("Pressed", "Moved", "Moved", "Released"), (begin, (begin + end) / 2, end, end)
        for kind, share in zip(kinds, shares, strict=True):
            where = {"x": left + share * width, "y": top + height * tall, "buttons": 1 if button == "left" else 2}
            self.send("Input.dispatchMouseEvent", type=f"mouse{kind}", button=button, clickCount=1, **where)
            self.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")  # moves are late

    def swipe(self, selector: str, *fingers: tuple[float, float], last: str = "touchEnd") -> None:
        """Move fingers over an element, each from one share of its width to another; last: or "touchCancel"."""
        self.send("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=len(fingers))
        left, top, width, height = self.box(selector)
        for kind, share in (("touchStart", 0.0), ("touchMove", 0.3), ("touchMove", 1.0)):
            across = [left + width * (begin + share * (end - begin)) for begin, end in fingers]
            points = [{"x": x, "y": top + height / 2, "id": finger} for finger, x in enumerate(across)]
            self.send("Input.dispatchTouchEvent", type=kind, touchPoints=points)
            self.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        self.send("Input.dispatchTouchEvent", type=last, touchPoints=[])
        self.send("Emulation.setTouchEmulationEnabled", enabled=False)

    def wheel(self, selector: str, pixels: float) -> None:
        """Turn the mouse's wheel over the middle of an element."""
        left, top, width, height = self.box(selector)
        middle = {"x": left + width / 2, "y": top + height / 2}
        self.send("Input.dispatchMouseEvent", type="mouseWheel", **middle, deltaX=0, deltaY=pixels)

    def look(self, width: int, height: int, dark: bool = False, scale: int = 1) -> None:
        """Choose the window's size in px, the system's colours, and the screen's pixels in one of CSS."""
        size = {"width": width, "height": height, "deviceScaleFactor": scale, "mobile": False}
        self.send("Emulation.setDeviceMetricsOverride", **size)
        colours = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.send("Emulation.setEmulatedMedia", features=[colours])

    def screenshot(self) -> np.ndarray:
        """What the window shows: BGR."""
        return decoded(base64.b64decode(self.send("Page.captureScreenshot", format="png")["data"]))

    def canvas(self, camera: str) -> np.ndarray:
        """What a camera's canvas shows: BGR."""
        pixels = f"document.querySelector('#{camera}').getContext('2d').getImageData(0, 0, 320, 160).data"
        return np.array(self.run(f"[...{pixels}].join()").split(","), np.uint8).reshape(160, 320, 4)[..., 2::-1]

    def difference(self, camera: str, picture: bytes) -> float:
        """The mean difference between a camera's canvas and an image file's contents, in grey levels."""
        return float(np.abs(self.canvas(camera).astype(int) - decoded(picture)).mean())

    def complaints(self) -> list[str]:
        """What the page's console has said: errors, and what the Content-Security-Policy has stopped."""
        self.run("0")
        found = []
        for event in self.events:
            parameters = event.get("params", {})
            if event.get("method") == "Runtime.exceptionThrown":
                details = parameters["exceptionDetails"]
                found.append(details.get("exception", {}).get("description", details["text"]))
            elif event.get("method") == "Log.entryAdded" and parameters["entry"]["level"] == "error":
                found.append(f"{parameters['entry']['text']} {parameters['entry'].get('url', '')}")
        return found

    def has_colours(self, dark: bool) -> bool:
        """Whether ink and paper are those for the system's colours, and far apart."""
        style = "getComputedStyle(document.body)"
        ink, paper = self.run(f"[{style}.color, {style}.backgroundColor]")
        level = [sum(map(int, re.findall(r"\d+", colour)[:3])) for colour in (ink, paper)]
        return (level[0] > level[1]) == dark and abs(level[0] - level[1]) > 400

    def fits(self) -> bool:
        """Whether nothing is wider than the window."""
        return self.run("document.documentElement.scrollWidth <= innerWidth")

    def barriers(self) -> list[str]:
        """What axe-core finds on the page that is a barrier to people, however small."""
        self.run(AXE.read_text(encoding="utf-8") + ";0")
        found = self.run("axe.run({resultTypes: ['violations']}).then(({violations}) => violations)")
        return [
            f"{each['id']}, {each['impact']}: {node['html']}: {node['failureSummary']}"
            for each in found
            for node in each["nodes"]
        ]

    def check_look(self, width: int, dark: bool) -> None:
        """The page fits one of LOOKS and bars nobody; the widest has no barrier that the others have not."""
        assert self.fits() and self.has_colours(dark)
        assert width == LOOKS[-1][0] or self.barriers() == []

    def addresses(self) -> list[str]:
        """What the page has asked for."""
        requests = [event for event in self.events if event.get("method") == "Network.requestWillBeSent"]
        return [event["params"]["request"]["url"] for event in requests]

    def close(self) -> None:
        with suppress(OSError, ValueError, websocket.WebSocketException):  # it may have ended
            self.send("Browser.close")
        self.socket.close()
        self.process.kill()
        self.process.communicate()


def decoded(picture: bytes) -> np.ndarray:
    """An image file's pixels: BGR."""
    pixels = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None
    return pixels


def chromium(profile: Path) -> closing[Page]:
    return closing(Page(profile))
