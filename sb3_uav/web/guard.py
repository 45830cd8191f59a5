"""
The gate in front of the app: who may ask, how much they may send, and what every answer says to browsers.

Plain ASGI (https://asgi.readthedocs.io/en/latest/specs/www.html), so that a body is measured while it comes in.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import ipaddress
import json
import secrets
from collections.abc import Awaitable, Callable, MutableMapping
from contextlib import suppress
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import urlsplit

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
SendFunction = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, SendFunction], Awaitable[None]]

_SAFE_METHODS = ("GET", "HEAD", "OPTIONS")
# Reachable without a login: the form, and the files of the page, which are the same for everybody.
_OPEN_PATHS = ("/login", "/static/")
_SECONDS_PER_BLOCK = 20.0
_SECONDS_PER_BODY = 120.0
_SECONDS_OF_LINGERING = 5.0
# Bodies of those who have not shown the token yet: a token has 500 characters at most.
_MOST_LOGIN_BYTES = 4096
_MOST_LOGINS = 8


class Keys:
    """
    Tokens and cookies.

    :param token: What clients have to show; None if everybody on this machine may ask
    :param port: Port of the server: cookies are shared by all ports of a host
    """

    def __init__(self, token: str | None, port: int) -> None:
        self._token = token
        self._login = hmac.new(secrets.token_bytes(32), b"login", hashlib.sha256).hexdigest()
        self.login_cookie, self.session_cookie = f"sb3_uav_login_{port}", f"sb3_uav_session_{port}"

    @property
    def login_value(self) -> str:
        """Value of the cookie of those who have shown the token. It ends with the server."""
        return self._login

    @property
    def is_open(self) -> bool:
        return self._token is None

    def fits(self, token: str) -> bool:
        return self._token is not None and hmac.compare_digest(token.encode(), self._token.encode())

    def admits(self, headers: dict[str, str]) -> bool:
        """:return: Whether a request may pass"""
        if self.is_open:
            return True
        kind, _, token = headers.get("authorization", "").partition(" ")
        if kind.lower() == "bearer" and self.fits(token.strip()):
            return True
        return hmac.compare_digest(cookie_of(headers, self.login_cookie).encode(), self._login.encode())


def cookie_of(headers: dict[str, str], name: str) -> str:
    """:return: A cookie of a request; empty if there is none"""
    try:
        found = SimpleCookie(headers.get("cookie", "")).get(name)
    except CookieError:
        return ""
    return "" if found is None else found.value


class Guard:
    """
    :param app: What is guarded
    :param keys: Who may ask
    :param names: Names of this server that a ``Host`` header may have. Addresses always pass: a page elsewhere can make a
        name of its own point to this machine, but no address (https://en.wikipedia.org/wiki/DNS_rebinding)
    :param max_body_bytes: Size of one request
    :param max_bodies: Requests with bodies at one time
    :param tiles: Where map tiles come from, as ``https://host``; None without tiles
    """

    def __init__(
        self, app: App, keys: Keys, names: set[str], max_body_bytes: int, max_bodies: int, tiles: str | None = None
    ) -> None:
        self._app, self._keys, self._max_body_bytes = app, keys, max_body_bytes
        self._names = {name.lower() for name in names}
        # Apart, so that clients without the token cannot take the places of those with it.
        self._bodies, self._logins = asyncio.Semaphore(max_bodies), asyncio.Semaphore(_MOST_LOGINS)
        images = f"'self' data: {tiles}" if tiles else "'self' data:"
        policy = (
            f"default-src 'none'; script-src 'self'; style-src 'self'; img-src {images}; connect-src 'self'; "
            "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )
        self._headers = [
            (b"content-security-policy", policy.encode()),
            (b"x-content-type-options", b"nosniff"),
            (b"x-frame-options", b"DENY"),
            # Servers of tiles want to know who asks.
            (b"referrer-policy", b"strict-origin-when-cross-origin" if tiles else b"no-referrer"),
            (b"cross-origin-opener-policy", b"same-origin"),
            (b"cross-origin-resource-policy", b"same-origin"),
            (b"permissions-policy", b"camera=(), microphone=(), geolocation=()"),
        ]

    async def __call__(self, scope: Scope, receive: Receive, send: SendFunction) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            # There are no websockets.
            await send({"type": "websocket.close", "code": 1008})
            return

        async def send_safely(message: MutableMapping[str, Any]) -> None:
            if message["type"] == "http.response.start":
                given = list(message.get("headers", ()))
                if not any(name.lower() == b"cache-control" for name, _ in given):
                    given.append((b"cache-control", b"no-store"))
                message = {**message, "headers": [*given, *self._headers]}
            await send(message)

        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        refusal = self._refusal(scope, headers)
        if refusal is not None:
            await _answer(send_safely, *refusal)
        elif "content-length" in headers or "transfer-encoding" in headers:
            await self._with_body(scope, headers, receive, send_safely)
        else:
            await self._app(scope, receive, send_safely)

    def _refusal(self, scope: Scope, headers: dict[str, str]) -> tuple[int, str, list[tuple[bytes, bytes]]] | None:
        """:return: Status, sentence and headers for a request that must not pass"""
        host = headers.get("host", "")
        if not self._is_own_name(host):
            return 421, f"This server is not called {host[:100]!r}; start it with --allow-host to admit that name.", []
        if scope["method"] not in _SAFE_METHODS and not _is_same_origin(headers, host):
            return 403, "This request comes from a page of another site.", []
        path: str = scope["path"]
        if any(path == entry or (entry.endswith("/") and path.startswith(entry)) for entry in _OPEN_PATHS):
            return None
        if not self._keys.admits(headers):
            if scope["method"] == "GET" and path == "/":
                return 303, "Log in first.", [(b"location", b"/login")]
            return 401, "Log in, or send the header Authorization: Bearer TOKEN.", [(b"www-authenticate", b"Bearer")]
        return None

    def _is_own_name(self, host: str) -> bool:
        try:
            name = (urlsplit(f"//{host}").hostname or "").rstrip(".")
        except ValueError:
            return False
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return name in self._names
        return True

    async def _with_body(self, scope: Scope, headers: dict[str, str], receive: Receive, send: SendFunction) -> None:
        """Read a body of limited size, and pass it on."""
        if "content-length" in headers and "transfer-encoding" in headers:
            # A proxy may see another end of this request (https://datatracker.ietf.org/doc/html/rfc9112#section-6.3).
            await _answer(send, 400, "Send either Content-Length or Transfer-Encoding, not both.", _CLOSE)
            return
        is_admitted = self._keys.admits(headers)
        places, most = (self._bodies, self._max_body_bytes) if is_admitted else (self._logins, _MOST_LOGIN_BYTES)
        most = min(most, self._max_body_bytes)
        length = headers.get("content-length", "0")
        if not length.isdecimal() or int(length[:20]) > most:
            await self._refuse_body(receive, send, most)
            return
        try:
            await asyncio.wait_for(places.acquire(), _SECONDS_PER_BLOCK)
        except asyncio.TimeoutError:
            await _answer(send, 503, "Too many files are being sent at this moment; try again in a minute.", _CLOSE)
            return
        try:
            body = await asyncio.wait_for(self._read(receive, most), _SECONDS_PER_BODY)
            if body is None:
                await self._refuse_body(receive, send, most)
                return
            messages = [{"type": "http.request", "body": body, "more_body": False}]
            del body

            async def receive_read() -> MutableMapping[str, Any]:
                return messages.pop() if messages else await receive()

            await self._app(scope, receive_read, send)
        except asyncio.TimeoutError:
            await _answer(send, 408, "The file came in too slowly.", _CLOSE)
        except _GoneError:
            return
        finally:
            places.release()

    async def _read(self, receive: Receive, most: int) -> bytes | None:
        """:return: The body; None as soon as it is too large"""
        body = bytearray()
        while True:
            message = await asyncio.wait_for(receive(), _SECONDS_PER_BLOCK)
            if message["type"] == "http.disconnect":
                raise _GoneError
            body += message.get("body", b"")
            if len(body) > most:
                return None
            if not message.get("more_body", False):
                return bytes(body)

    async def _refuse_body(self, receive: Receive, send: SendFunction, most: int) -> None:
        """
        Say that a body is too large, and throw away what still comes in for a moment: a connection that is closed while a
        client sends is reset, and then the client never sees the sentence.
        """
        sentence = f"A request may have {most / 2**20:g} MiB at most."
        await _answer(send, 413, sentence, _CLOSE, is_last=False)
        with suppress(asyncio.TimeoutError):
            await asyncio.wait_for(_drain(receive), _SECONDS_OF_LINGERING)
        await send({"type": "http.response.body", "body": b""})


class _GoneError(Exception):
    """The client has closed the connection."""


async def _drain(receive: Receive) -> None:
    while True:
        message = await receive()
        if message["type"] == "http.disconnect" or not message.get("more_body", False):
            return


# Else the server would read the rest of the body to get to the next request.
_CLOSE = [(b"connection", b"close")]


def _is_same_origin(headers: dict[str, str], host: str) -> bool:
    """Browsers say where a request comes from; programs that are none need not."""
    origin = headers.get("origin")
    if origin is not None:
        try:
            return urlsplit(origin).netloc.lower() == host.lower()
        except ValueError:
            return False
    return headers.get("sec-fetch-site", "none") in ("same-origin", "none")


async def _answer(
    send: SendFunction, status: int, sentence: str, headers: list[tuple[bytes, bytes]], is_last: bool = True
) -> None:
    body = json.dumps({"detail": sentence}).encode()
    about = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
    await send({"type": "http.response.start", "status": status, "headers": [*about, *headers]})
    await send({"type": "http.response.body", "body": body, "more_body": not is_last})
