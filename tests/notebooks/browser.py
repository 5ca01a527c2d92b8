"""A headless Chromium that tests can drive: tabs, what they load, and what they say, over the DevTools protocol.

The protocol runs through two pipes, so nothing beyond the standard library is needed and no port is opened. The browser
is told that no name can be resolved: what a page asks of the network is recorded, and nothing leaves the machine.
"""

from __future__ import annotations

import json
import os
import queue
import shutil
import subprocess
import sys
import threading
import time
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path

CHECKS = Path(__file__).with_name("page.js").read_text(encoding="utf-8")
LOCAL = ("file:", "data:", "blob:", "about:")
NAMES = ("chromium", "chromium-browser", "google-chrome")
LIMIT_S = 120.0  # for one answer of the browser, and for one page to load
# Chromium reads commands from descriptor 3 and answers on 4; this puts the pipes there and becomes the browser.
LAUNCH = (
    "import fcntl, os, sys; near, far = (fcntl.fcntl(int(word), fcntl.F_DUPFD, 10) for word in sys.argv[1:3]); "
    "os.dup2(near, 3); os.dup2(far, 4); os.execvp(sys.argv[3], sys.argv[3:])"
)
FLAGS = [
    "--headless",
    "--remote-debugging-pipe",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--no-first-run",
    "--no-default-browser-check",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-extensions",
    "--disable-default-apps",
    "--disable-quic",
    "--disable-features=Translate",
    "--disable-background-timer-throttling",
    "--disable-renderer-backgrounding",
    "--disable-backgrounding-occluded-windows",
    "--mute-audio",
]


class BrowserError(RuntimeError):
    """The browser did not start, did not answer, or refused a command."""


@dataclass(frozen=True)
class View:
    """How a page is looked at: the window's width and height [CSS pixels], the colour scheme, the medium."""

    width: int
    height: int = 900
    dark: bool = False
    medium: str = "screen"


@dataclass(frozen=True)
class Visit:
    """What a page was found to be: its address, the view, faults as (rule, what), and what it holds.

    ``links`` are pairs of the address and what the page says for it, ``anchors`` the names that can be linked to, and
    ``counts`` the numbers of equations, images and canvases; ``theme`` is "light" or "dark"; ``picture`` is how far down
    the first picture ends [px].
    """

    address: str
    view: View
    faults: list[tuple[str, str]]
    links: list[tuple[str, str]]
    anchors: set[str]
    theme: str
    counts: dict[str, int]
    picture: int | None


def find_chromium() -> str | None:
    """Name the browser: the environment's ``ROL_CHROMIUM``, else the first of the usual names on the path."""
    named = os.environ.get("ROL_CHROMIUM")
    if named:
        return shutil.which(named)
    return next((found for found in map(shutil.which, NAMES) if found), None)


class Browser:
    """One running Chromium; its methods may be called from several threads.

    Parameters
    ----------
    executable : str
        The program.
    folder : Path
        An empty folder for the browser's own files.
    """

    def __init__(self, executable: str, folder: Path) -> None:
        commands_out, self._commands = os.pipe()
        self._answers, answers_in = os.pipe()
        flags = [*FLAGS, "--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={folder / 'profile'}"]
        launch = [sys.executable, "-c", LAUNCH, str(commands_out), str(answers_in), executable, *flags]
        self._said = (folder / "browser.log").open("w+b")
        self._process = subprocess.Popen(
            [*launch, "about:blank"],
            pass_fds=(commands_out, answers_in),
            stdin=subprocess.DEVNULL,
            stdout=self._said,
            stderr=self._said,
        )
        os.close(commands_out)
        os.close(answers_in)
        self._lock = threading.Lock()
        self._number, self._ended = 0, False
        self._shared: Tab | None = None
        self._waiting: dict[int, Future] = {}
        self._events: dict[str, queue.SimpleQueue] = {}
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        try:
            self.version = self.call("Browser.getVersion")["product"]
        except BrowserError:
            self.close()
            raise

    def _read(self) -> None:
        """Hand every message of the browser to the one who waits for it."""
        rest = b""
        while part := os.read(self._answers, 1 << 20):
            *whole, rest = (rest + part).split(b"\0")
            for text in whole:
                message = json.loads(text)
                if "id" in message:
                    self._waiting.pop(message["id"]).set_result(message)
                elif message.get("sessionId") in self._events:
                    self._events[message["sessionId"]].put(message)
        self._ended = True
        for future in list(self._waiting.values()):
            future.set_exception(BrowserError(f"the browser has ended: {self._last_words()}"))

    def _last_words(self) -> str:
        return Path(self._said.name).read_text(encoding="utf-8", errors="replace")[-2000:]

    def call(self, method: str, session: str | None = None, **params: object) -> dict:
        """Send one command and give its result."""
        future: Future = Future()
        with self._lock:
            self._number += 1
            self._waiting[self._number] = future
            message = {"id": self._number, "method": method, "params": params}
            if session:
                message["sessionId"] = session
            try:
                _write_all(self._commands, json.dumps(message).encode() + b"\0")
            except BrokenPipeError as error:
                raise BrowserError(f"the browser did not start: {self._last_words()}") from error
        if self._ended:
            raise BrowserError(f"the browser has ended: {self._last_words()}")
        try:
            answer = future.result(LIMIT_S)
        except TimeoutError as error:
            raise BrowserError(f"no answer to {method} within {LIMIT_S:.0f} s") from error
        if "error" in answer:
            raise BrowserError(f"{method}: {answer['error']['message']}")
        return answer["result"]

    def tab(self) -> Tab:
        """Open a new tab."""
        target = self.call("Target.createTarget", url="about:blank", newWindow=True)["targetId"]
        session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self._events[session] = queue.SimpleQueue()
        return Tab(self, session, self._events[session])

    def shared_tab(self) -> Tab:
        """Give the one tab that is kept for small pages."""
        if self._shared is None:
            self._shared = self.tab()
        return self._shared

    def close(self) -> None:
        """End the browser and wait until it is gone."""
        try:
            self.call("Browser.close")
            self._process.wait(LIMIT_S)
        except (BrowserError, subprocess.TimeoutExpired):
            self._process.kill()
            self._process.wait()
        self._reader.join(LIMIT_S)
        os.close(self._commands)
        os.close(self._answers)
        self._said.close()


def _write_all(descriptor: int, data: bytes) -> None:
    while data:
        data = data[os.write(descriptor, data) :]


class Tab:
    """One tab: it opens pages one after the other and keeps what happened since the last one was opened."""

    def __init__(self, browser: Browser, session: str, events: queue.SimpleQueue) -> None:
        self._browser, self._session, self._queue = browser, session, events
        self._events: list[dict] = []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params: object) -> dict:
        """Send one command to this tab and give its result."""
        return self._browser.call(method, self._session, **params)

    def look(self, view: View) -> None:
        """Set the window's size, the colour scheme that the reader prefers, and the medium."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=view.width,
            height=view.height,
            deviceScaleFactor=1,
            mobile=False,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if view.dark else "light"}
        self.call("Emulation.setEmulatedMedia", media=view.medium, features=[scheme])

    def open(self, address: str, view: View) -> None:
        """Load a page from new, until its load event."""
        self.call("Page.navigate", url="about:blank")
        self.wait_for("Page.loadEventFired", times=1 + self._count("Page.loadEventFired"))
        self.look(view)
        self.events.clear()
        answer = self.call("Page.navigate", url=address)
        if "errorText" in answer:
            raise BrowserError(f"{address}: {answer['errorText']}")
        self.wait_for("Page.loadEventFired")

    def _count(self, method: str) -> int:
        return sum(event["method"] == method for event in self._events)

    def wait_for(self, method: str, times: int = 1) -> None:
        """Take in events until one of this kind has come, or so many since the page was opened."""
        end = time.monotonic() + LIMIT_S
        while self._count(method) < times:
            try:
                self._events.append(self._queue.get(timeout=max(0.0, end - time.monotonic())))
            except queue.Empty as error:
                raise BrowserError(f"no {method} within {LIMIT_S:.0f} s") from error

    @property
    def events(self) -> list[dict]:
        """What happened since the page was opened, in order."""
        while not self._queue.empty():
            self._events.append(self._queue.get())
        return self._events

    def run(self, script: str) -> object:
        """Evaluate JavaScript in the page, wait for a promise, and give its value."""
        answer = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in answer:
            details = answer["exceptionDetails"]
            raise BrowserError(details.get("exception", {}).get("description", details["text"]))
        return answer["result"].get("value")

    def visit(self, address: str, view: View) -> Visit:
        """Open a page, let it come to rest, and judge it by every rule."""
        self.open(address, view)
        seen = self.run(f"({CHECKS})()")
        faults = [*heard_faults(self.events), *((rule, what) for rule, what in seen["faults"])]
        links = [(whole, said) for whole, said in seen["links"]]
        return Visit(
            address, view, faults, links, set(seen["anchors"]), seen["theme"], seen["counts"], seen["picture"]
        )


def heard_faults(events: list[dict]) -> list[tuple[str, str]]:
    """List what a page said to the console, what it could not get, and what it asked of the network."""
    faults, asked = [], {}
    for event in events:
        params = event["params"]
        if event["method"] == "Runtime.consoleAPICalled" and params["type"] in ("error", "warning", "assert"):
            words = [str(word.get("value", word.get("description"))) for word in params["args"]]
            faults.append(("console", f"{params['type']}: {' '.join(words)}"))
        elif event["method"] == "Runtime.exceptionThrown":
            details = params["exceptionDetails"]
            words = details.get("exception", {}).get("description", details["text"])
            faults.append(("console", f"line {details['lineNumber'] + 1}: {words}"))
        elif event["method"] == "Log.entryAdded" and params["entry"]["level"] in ("error", "warning"):
            faults.append(("console", f"{params['entry']['text']} {params['entry'].get('url', '')}"))
        elif event["method"] == "Network.requestWillBeSent":
            asked[params["requestId"]] = params["request"]["url"]
            if not params["request"]["url"].startswith(LOCAL):
                faults.append(("request", f"asks the network: {params['request']['url']}"))
        elif event["method"] == "Network.loadingFailed":
            faults.append(("request", f"{params['errorText']}: {asked.get(params['requestId'], '?')}"))
    return faults
