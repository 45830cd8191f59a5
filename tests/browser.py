"""A real browser for tests: Debian's chromium, headless, watched for errors and for requests that leave the machine."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Dialog, Page

CHROMIUMS = ("chromium", "chromium-browser", "google-chrome")
_LOCAL_SCHEMES = {"file", "data", "blob", "about"}
_LOOPBACK = {"127.0.0.1", "localhost", "::1"}
# Whatever the page does, and whatever chromium does on its own, no name but these is resolved.
_RULES = "MAP * ~NOTFOUND, EXCLUDE localhost, EXCLUDE 127.0.0.1"
_ARGUMENTS = (
    f"--host-resolver-rules={_RULES}",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-dev-shm-usage",
    "--no-first-run",
)
_PATIENCE_MS = 20_000


def chromium_path() -> str:
    """:return: The path of the chromium that is installed; the test is skipped if there is none"""
    for name in CHROMIUMS:
        if path := shutil.which(name):
            return path
    pytest.skip(f"no browser: none of {', '.join(CHROMIUMS)} is installed")


def stays_here(url: str) -> bool:
    """:return: Whether a request of this address stays on the machine"""
    parts = urlsplit(url)
    if parts.scheme in {"http", "https", "ws", "wss"}:
        return parts.hostname in _LOOPBACK
    # On Windows, file://host/ is a share of another machine.
    return parts.scheme in _LOCAL_SCHEMES and not parts.hostname


@dataclass
class Visit:
    """
    What happens in one window with its own cookies and storage.

    :ivar page: The page, as of playwright
    :ivar context: The window, for further pages
    :ivar errors: Errors on the console, exceptions that nothing caught, and dialogs that opened (``alert(1)``)
    :ivar left: Addresses of requests that would have left the machine; they were stopped
    :ivar requests: Addresses of all requests
    """

    page: Page
    context: BrowserContext
    errors: list[str] = field(default_factory=list)
    left: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def check(self, allowed: tuple[str, ...] = ()) -> None:
        """
        :param allowed: Regular expressions of errors that a test provokes
        :raises AssertionError: If there was any other error, or a request that leaves the machine
        """
        assert not self.left, f"requests left the machine: {self.left}"
        unexpected = [error for error in self.errors if not any(re.search(pattern, error) for pattern in allowed)]
        assert not unexpected, f"errors in the browser: {unexpected}"

    def __post_init__(self) -> None:
        def note_request(url: str) -> None:
            self.requests.append(url)
            if not stays_here(url):
                self.left.append(url)

        def note_console(said: ConsoleMessage) -> None:
            if said.type == "error":
                self.errors.append(f"console: {said.text}")

        def note_dialog(dialog: Dialog) -> None:
            self.errors.append(f"dialog: {dialog.message}")
            dialog.dismiss()

        self.context.on("request", lambda request: note_request(request.url))
        self.context.on("console", note_console)
        self.context.on("weberror", lambda error: self.errors.append(f"uncaught: {error.error}"))
        self.context.on("page", lambda page: page.on("websocket", lambda socket: note_request(socket.url)))
        self.page.on("websocket", lambda socket: note_request(socket.url))
        self.context.on("dialog", note_dialog)


@contextmanager
def running_browser() -> Iterator[Browser]:
    """
    Start chromium; the test is skipped, with the reason, where it or playwright is missing. One may serve many tests, from a
    fixture of a module.

    :return: The browser, as of playwright
    """
    playwright = pytest.importorskip("playwright.sync_api", reason="no browser: playwright is not installed")
    path = chromium_path()
    with playwright.sync_playwright() as driver:
        # Tests may run as root, where chromium refuses to start with its sandbox.
        browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox", *_ARGUMENTS])
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def visit_in(browser: Browser, allowed: tuple[str, ...] = (), width: int = 1280, height: int = 900) -> Iterator[Visit]:
    """
    A new window in a running browser. At the end of the block the test fails on errors, and on requests that left.

    :param browser: Of :func:`running_browser`
    :param allowed: As of :meth:`Visit.check`
    :param width: Of the window in pixels
    :param height: Of the window in pixels
    :return: The window, with an empty page
    """
    context = browser.new_context(viewport={"width": width, "height": height}, accept_downloads=True, service_workers="block")
    context.set_default_timeout(_PATIENCE_MS)
    # Stopped before they are sent; the listeners of the visit still see them.
    context.route(lambda url: not stays_here(url), lambda route: route.abort())
    try:
        visit = Visit(context.new_page(), context)
        yield visit
        visit.check(allowed)
    finally:
        context.close()


@contextmanager
def open_browser(allowed: tuple[str, ...] = (), width: int = 1280, height: int = 900) -> Iterator[Visit]:
    """
    :func:`running_browser` and :func:`visit_in` in one, for tests that need a browser once::

        with open_browser() as visit:
            visit.page.goto(path.as_uri())

    :param allowed: As of :meth:`Visit.check`
    :param width: Of the window in pixels
    :param height: Of the window in pixels
    :return: The window, with an empty page
    """
    with running_browser() as browser, visit_in(browser, allowed, width, height) as visit:
        yield visit
