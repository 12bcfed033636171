"""A headless Chromium with one page, driven by its DevTools protocol through two pipes."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import tempfile
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from tests.system.stage.processes import wait_for

ANSWER_S = 60.0
PROGRAM = ("chromium", "--headless=new", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe", "--no-first-run")
OWN = ("about:", "chrome:", "data:", "blob:", "devtools:")
"""Addresses that reach no host."""
ASKED_AGAIN = "performance.getEntriesByType('resource').some(each => each.name.includes('part=main') && each.responseEnd)"


class Page:
    """A page, what it asked for and what went wrong in it; while it is entered."""

    def __init__(self) -> None:
        self.requests: list[str] = []
        """every address that was asked for, of pages, scripts, films and the like"""
        self.errors: list[str] = []
        """what the console shows as an error: exceptions, broken rules, answers that are failures; and dialogs"""
        self._folder = tempfile.TemporaryDirectory(dir="/tmp", prefix="page-")  # Chromium's socket needs a short path
        folder = Path(self._folder.name)
        commands, self._commands = os.pipe()
        self._answers, answers = os.pipe()
        words = [*PROGRAM, f"--user-data-dir={folder}", "about:blank"]
        shell = f'exec "$@" 3<&{commands} 4>&{answers}'
        self._said = folder / "said"
        with self._said.open("w") as said:
            self._process = subprocess.Popen(
                ["bash", "-c", shell, "chromium", *words],
                env={**os.environ, "TMPDIR": str(folder)},
                pass_fds=(commands, answers),
                stdout=said,
                stderr=said,
                start_new_session=True,
            )
        os.close(commands)
        os.close(answers)
        self._rest, self._number, self._session = b"", 0, ""

    def __enter__(self) -> Self:
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.ask(f"{domain}.enable")
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        os.close(self._commands)
        os.close(self._answers)
        self._folder.cleanup()

    def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command, and return its result. Events that come before it are noted."""
        self._number += 1
        session = {"sessionId": self._session} if self._session else {}
        message = {"id": self._number, "method": method, "params": parameters} | session
        os.write(self._commands, json.dumps(message).encode() + b"\0")
        deadline_s = time.monotonic() + ANSWER_S
        while True:
            for each in self._messages(deadline_s - time.monotonic()):
                self._note(each)
                if each.get("id") == self._number:
                    assert "error" not in each, each
                    result: dict[str, Any] = each["result"]
                    return result

    def value(self, script: str) -> Any:
        """The value of an expression in the page."""
        found = self.ask("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def open(self, address: str) -> None:
        """Go to an address, and wait until the page has asked for its main part once more."""
        self.ask("Page.navigate", url=address)
        wait_for(lambda: self.value(ASKED_AGAIN), ANSWER_S, f"{address} asks again")

    def press(self, key: str, code: int) -> None:
        """Press a key that types nothing. `code`: its Windows virtual key code."""
        for kind in ("rawKeyDown", "keyUp"):
            self.ask("Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=code)

    def _messages(self, timeout_s: float) -> list[dict[str, Any]]:
        assert select.select([self._answers], [], [], max(0.0, timeout_s))[0], "Chromium does not answer"
        content = os.read(self._answers, 1 << 20)
        assert content, f"Chromium has ended: {self._said.read_text()[-2_000:]}"
        *whole, self._rest = (self._rest + content).split(b"\0")
        return [json.loads(each) for each in whole]

    def _note(self, message: dict[str, Any]) -> None:
        match message:
            case {"method": "Network.requestWillBeSent", "params": {"request": {"url": url}}} if not url.startswith(OWN):
                self.requests.append(url)
            case {"method": "Runtime.exceptionThrown", "params": details}:
                self.errors.append(str(details))
            case {"method": "Log.entryAdded", "params": {"entry": {"level": "error"} as entry}}:
                self.errors.append(str(entry))
            case {"method": "Page.javascriptDialogOpening", "params": details}:
                self.errors.append(str(details))
            case {"method": "Runtime.consoleAPICalled", "params": {"type": "error" | "assert"} as details}:
                self.errors.append(str(details))
