"""A real Chromium for the tests, told what to do over a pipe in its DevTools protocol."""

import base64
import json
import os
import select
import shutil
import subprocess
import time
from contextlib import contextmanager, suppress
from pathlib import Path

AXE = Path(__file__).with_name("axe.min.js")  # axe-core 4.14.1 by Deque Systems, MPL-2.0: see axe.LICENSE
CHROMIUM = shutil.which("chromium")
OPTIONS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update", "--remote-debugging-pipe"),
)


class Page:
    """A page in Chromium: one tab."""

    def __init__(self, profile: Path):
        inward, self.outgoing = os.pipe()
        self.incoming, outward = os.pipe()
        # Chromium reads at 3 and writes at 4; the shell puts the pipes there.
        command = f'exec "$0" "$@" 3<&{inward} 4>&{outward}'
        self.process = subprocess.Popen(
            ["bash", "-c", command, CHROMIUM, *OPTIONS, f"--user-data-dir={profile}", "about:blank"],
            pass_fds=(inward, outward),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(inward)
        os.close(outward)
        self.number, self.buffer, self.session, self.events = 0, b"", None, []
        tabs = self.until(lambda: [t for t in self.send("Target.getTargets")["targetInfos"] if t["type"] == "page"])
        self.session = self.send("Target.attachToTarget", targetId=tabs[0]["targetId"], flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")

    def until(self, condition, seconds: float = 60.0):
        """Wait until a condition is true; return its value."""
        end = time.monotonic() + seconds
        while not (value := condition()):
            assert time.monotonic() < end, "the browser never got there"
            time.sleep(0.02)
        return value

    def send(self, method: str, **parameters) -> dict:
        self.number += 1
        message = {"id": self.number, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.outgoing, json.dumps(message).encode() + b"\0")
        while True:
            answer = self.receive()
            if answer.get("id") == self.number:
                assert "error" not in answer, answer
                return answer["result"]
            self.events.append(answer)

    def receive(self) -> dict:
        while b"\0" not in self.buffer:
            assert select.select([self.incoming], [], [], 60)[0], "the browser does not answer"
            data = os.read(self.incoming, 1 << 20)
            assert data, "the browser has ended"
            self.buffer += data
        message, _, self.buffer = self.buffer.partition(b"\0")
        return json.loads(message)

    def run(self, code: str):
        """Evaluate JavaScript, await it, and return its value."""
        done = self.send("Runtime.evaluate", expression=code, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in done, done
        return done["result"].get("value")

    def wait(self, code: str, seconds: float = 60.0) -> None:
        """Wait until a JavaScript expression is true."""
        try:
            self.until(lambda: self.run(f"Boolean({code})"), seconds)
        except AssertionError as error:
            raise AssertionError(f"{code}: {error}; the page shows: {self.run('document.body.innerText')}") from None

    def open(self, address: str) -> None:
        """Load a page anew; what an earlier one asked for and said is forgotten."""
        self.send("Page.navigate", url="about:blank")
        self.wait("location.href == 'about:blank' && document.readyState == 'complete'")
        self.events.clear()
        self.send("Page.navigate", url=address)

    def text(self) -> str:
        return self.run("document.body.innerText")

    def press(self, key: str, shift: bool = False) -> None:
        """Press and release a key, by its name in JavaScript."""
        character = {"text": "\r" if key == "Enter" else key} if len(key) == 1 or key == "Enter" else {}
        codes = {"Enter": 13, "Escape": 27, " ": 32, "Tab": 9}
        code = {"windowsVirtualKeyCode": codes[key]} if key in codes else {}
        both = {"key": key, "modifiers": 8 * shift, **code}
        self.send("Input.dispatchKeyEvent", type="keyDown", **both, **character)
        self.send("Input.dispatchKeyEvent", type="keyUp", **both)

    def look(self, width: int, height: int, dark: bool = False, scale: float = 1.0) -> None:
        """Choose the window's size in px and the system's colours."""
        self.send(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=scale, mobile=False
        )
        self.send(
            "Emulation.setEmulatedMedia",
            features=[{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}],
        )

    def screenshot(self, path: Path, whole: bool = False) -> None:
        picture = self.send("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        Path(path).write_bytes(base64.b64decode(picture["data"]))

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

    def barriers(self) -> list[str]:
        """What axe-core finds on the page that is a serious or critical barrier to people."""
        self.run(AXE.read_text(encoding="utf-8") + ";0")
        found = self.run("axe.run({resultTypes: ['violations']}).then(({violations}) => violations)")
        return [
            f"{each['id']}: {node['html']}: {node['failureSummary']}"
            for each in found
            if each["impact"] in ("serious", "critical")
            for node in each["nodes"]
        ]

    def addresses(self) -> list[str]:
        """What the page has asked for."""
        return [
            event["params"]["request"]["url"]
            for event in self.events
            if event.get("method") == "Network.requestWillBeSent"
        ]

    def close(self) -> None:
        with suppress(OSError, AssertionError):
            self.session = None
            self.send("Browser.close")
        self.process.kill()
        self.process.wait()
        os.close(self.outgoing)
        os.close(self.incoming)


@contextmanager
def chromium(profile: Path):
    page = Page(profile)
    try:
        yield page
    finally:
        page.close()
