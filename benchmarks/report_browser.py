"""Opens a run's report in headless Chromium as a reader would: errors, requests, the 3D view, both themes, print.

    python benchmarks/report_browser.py RUN [--pictures FOLDER]

Tells on stdout, as one JSON object, what was found; exits with 1 if something is wrong.
"""

from __future__ import annotations

import argparse
import base64
import fcntl
import json
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

WIDTH_PX, HEIGHT_PX = 1280, 900
# A software renderer on a busy machine is slow, and nobody waits for it but this check.
_PATIENCE_S = 120.0
_INERT = ("file:", "data:", "blob:", "about:")
_EYE = "(() => { const c = window.__view._fullLayout.scene._scene.getCamera().eye; return [c.x, c.y, c.z]; })()"


def chromium() -> str | None:
    """The browser's program, None if this machine has none."""
    return shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


class Tab:
    """A tab of a browser that is spoken to through a pipe (Chrome DevTools Protocol).

    Args:
        send: Where commands go.
        receive: Where answers and events come from.
    """

    def __init__(self, send: int, receive: int) -> None:
        self._send, self._receive = send, receive
        self._rest, self._number, self._session = b"", 0, None
        self.events: list[dict[str, Any]] = []
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.ask(f"{domain}.enable")

    def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Sends a command and waits for its answer; events that come meanwhile are kept."""
        self._number += 1
        said: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            said["sessionId"] = self._session
        os.write(self._send, json.dumps(said).encode() + b"\0")
        while True:
            heard = self._next()
            if heard.get("id") == self._number:
                if "error" in heard:
                    raise RuntimeError(f"{method}: {heard['error']}")
                return heard["result"]
            self.events.append(heard)

    def value(self, expression: str) -> Any:
        """What an expression of the page gives."""
        found = self.ask("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in found:
            raise RuntimeError(f"{expression}: {found['exceptionDetails']}")
        return found["result"].get("value")

    def wait_for(self, expression: str) -> None:
        """Waits until an expression of the page is true."""
        end = time.monotonic() + _PATIENCE_S
        while not self.value(expression):
            if time.monotonic() > end:
                raise TimeoutError(expression)
            time.sleep(0.1)

    def picture(self, path: Path, *, whole: bool) -> None:
        """Writes a screenshot of what is in view, or of the whole page."""
        found = self.ask("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(found["data"]))

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            some = os.read(self._receive, 1 << 20)
            if not some:
                raise RuntimeError("the browser has ended")
            self._rest += some
        text, _, self._rest = self._rest.partition(b"\0")
        found: dict[str, Any] = json.loads(text)
        return found


@contextmanager
def opened(program: str) -> Iterator[Tab]:
    """A tab of a browser of its own, which ends with it."""
    to_read, send = os.pipe()
    receive, to_write = os.pipe()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile, Path(os.devnull).open("w") as nowhere:
        command = [
            program, "--headless=new", "--no-sandbox", "--enable-unsafe-swiftshader", "--remote-debugging-pipe",
            "--no-first-run", "--hide-scrollbars", f"--window-size={WIDTH_PX},{HEIGHT_PX}",
            f"--user-data-dir={profile}",
        ]  # fmt: skip
        # The browser reads commands from descriptor 3 and writes answers to 4; ours may have these numbers themselves.
        high = [fcntl.fcntl(one, fcntl.F_DUPFD, 100) for one in (to_read, to_write, nowhere.fileno())]
        actions = [(os.POSIX_SPAWN_DUP2, *ends) for ends in zip(high, (3, 4, 2), strict=True)]
        process = os.posix_spawn(program, command, os.environ, file_actions=actions)
        for one in (*high, to_read, to_write):
            os.close(one)
        try:
            yield Tab(send, receive)
        finally:
            os.kill(process, signal.SIGTERM)
            os.waitpid(process, 0)
            os.close(send)
            os.close(receive)


def check(page: Path, pictures: Path | None) -> dict[str, Any]:
    """Opens a report and does what a reader does.

    Args:
        page: The report's index.html.
        pictures: Where screenshots and the print go; None for none.

    Returns:
        `errors` of the console, `requests` to the network, `figures` and how many were `drawn`, `turned` (whether
        dragging turned the 3D view; null without one), `overflow_px` on a narrow screen and `pages` of the print.
    """
    program = chromium()
    if program is None:
        raise FileNotFoundError("no Chromium on this machine")
    with opened(program) as tab:
        tab.ask("Page.navigate", url=page.resolve().as_uri())
        tab.wait_for("document.readyState === 'complete'")
        _read(tab)
        found = {
            "figures": tab.value("document.querySelectorAll('.plot').length"),
            "drawn": tab.value("document.querySelectorAll('.plot .main-svg, .plot .gl-container').length > 0 && "
                               "[...document.querySelectorAll('.plot')].filter(p => p._fullLayout).length"),
            "turned": _turned(tab, pictures),
        }  # fmt: skip
        if pictures:
            for theme in ("light", "dark"):
                tab.ask("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": theme}])
                time.sleep(1.0)
                tab.picture(pictures / f"{theme}.png", whole=True)
        found["pages"] = _printed(tab, pictures)
        found["overflow_px"] = _narrow(tab, pictures)
        return {"errors": errors(tab.events), "requests": requests(tab.events), **found}


def errors(events: list[dict[str, Any]]) -> list[str]:
    """What the console showed as an error, and exceptions nobody caught."""
    found = []
    for event in events:
        told = event.get("params", {})
        if event.get("method") == "Runtime.exceptionThrown":
            found.append(str(told["exceptionDetails"].get("exception", {}).get("description", told)))
        if event.get("method") == "Runtime.consoleAPICalled" and told["type"] in {"error", "assert"}:
            found.append(" ".join(str(one.get("value", one.get("description"))) for one in told["args"]))
        if event.get("method") == "Log.entryAdded" and told["entry"]["level"] == "error":
            found.append(told["entry"]["text"])
    return found


def requests(events: list[dict[str, Any]]) -> list[str]:
    """Addresses that the page asked the network for."""
    asked = [e["params"]["request"]["url"] for e in events if e.get("method") == "Network.requestWillBeSent"]
    return [url for url in asked if not url.startswith(_INERT)]


def _read(tab: Tab) -> None:
    """Scrolls through the page, so that every figure is drawn."""
    count = tab.value("document.querySelectorAll('.plot').length")
    for number in range(count):
        tab.value(f"document.querySelectorAll('.plot')[{number}].scrollIntoView({{behavior: 'instant'}})")
        tab.wait_for(f"Boolean(document.querySelectorAll('.plot')[{number}]._fullLayout)")
    tab.value("scrollTo({top: 0, behavior: 'instant'})")


def _turned(tab: Tab, pictures: Path | None) -> bool | None:
    """Drags the 3D view with the mouse and tells whether its camera went elsewhere."""
    find = "[...document.querySelectorAll('.plot')].find(p => p._fullLayout && p._fullLayout.scene)"
    if not tab.value(f"Boolean(window.__view = {find})"):
        return None
    tab.value("window.__view.scrollIntoView({block: 'center', behavior: 'instant'})")
    time.sleep(0.5)
    box = tab.value(
        "(() => { const b = window.__view.getBoundingClientRect(); return [b.x, b.y, b.width, b.height] })()"
    )
    x, y = box[0] + box[2] * 0.4, box[1] + box[3] * 0.5
    before = tab.value(_EYE)
    if pictures:
        tab.picture(pictures / "view_before.png", whole=False)
    _mouse(tab, "mousePressed", x, y)
    for step in range(1, 11):
        _mouse(tab, "mouseMoved", x + 15 * step, y + 4 * step)
    _mouse(tab, "mouseReleased", x + 150, y + 40)
    time.sleep(1.0)
    if pictures:
        tab.picture(pictures / "view_after.png", whole=False)
    after = tab.value(_EYE)
    return max(abs(a - b) for a, b in zip(after, before, strict=True)) > 0.01


def _mouse(tab: Tab, kind: str, x: float, y: float) -> None:
    tab.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)
    time.sleep(0.03)


def _printed(tab: Tab, pictures: Path | None) -> int:
    found = tab.ask("Page.printToPDF", preferCSSPageSize=True, printBackground=True)
    pdf = base64.b64decode(found["data"])
    if pictures:
        (pictures / "print.pdf").write_bytes(pdf)
    return pdf.count(b"/Type /Page\n") or pdf.count(b"/Type /Page")


def _narrow(tab: Tab, pictures: Path | None) -> int:
    """By how much the page is wider than a phone; tables scroll within it."""
    tab.ask("Emulation.setDeviceMetricsOverride", width=390, height=844, deviceScaleFactor=1, mobile=True)
    time.sleep(1.0)
    if pictures:
        tab.picture(pictures / "narrow.png", whole=False)
    return int(tab.value("document.documentElement.scrollWidth - document.documentElement.clientWidth"))


def main() -> int:
    """Checks a run's report."""
    parser = argparse.ArgumentParser(description="Opens a run's report in headless Chromium.")
    parser.add_argument("run", type=Path)
    parser.add_argument("--pictures", type=Path)
    options = parser.parse_args()
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
    found = check(options.run / "report" / "index.html", options.pictures)
    print(json.dumps(found, indent=1))
    wrong = found["errors"] or found["requests"] or found["turned"] is False or found["drawn"] != found["figures"]
    return int(bool(wrong or found["overflow_px"] > 0))


if __name__ == "__main__":
    sys.exit(main())
