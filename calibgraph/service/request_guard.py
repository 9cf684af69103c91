"""What every request passes: its host and origin, its token, the size and time of its body."""

import asyncio
import hashlib
import re
import secrets
import time
from base64 import b64decode
from contextlib import suppress
from pathlib import Path
from urllib.parse import SplitResult, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from calibgraph.errors import FileError
from calibgraph.files import read_text, write_text
from calibgraph.service.problems import Problem
from calibgraph.service.requests import Settings

Tokens = frozenset[str]
"""The SHA-256 of each token."""

_LINE = re.compile("[0-9a-f]{64}")
_REALM = 'Basic realm="calibgraph: any name, a token as the password"'

STRICT_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; object-src 'none'; base-uri 'none'; "
    "form-action 'self'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",  # without a referrer a form has no Origin
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
"""Of every answer that does not set its own."""

LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")
UPLOADS = "/v1/jobs/"
"""Paths that take recordings; other bodies are small."""

BODY_S, BODY_BYTES_PER_S = 20.0, 500.0
"""A body has so many seconds, and one more for so many bytes that have arrived."""

UNREAD_S = 1.0
"""For the rest of a body that was answered before its end; then the connection ends."""

_SAFE = ("GET", "HEAD", "OPTIONS")


class RequestGuard:
    """Checks requests before any route, adds headers to all answers.

    A page of another site that a browser shows could otherwise call a server without tokens: its
    name is then not one of ours, or its ``Origin`` is another one.
    """

    def __init__(self, app: ASGIApp, settings: Settings, tokens: Tokens | None) -> None:
        self._app, self._settings, self._tokens = app, settings, tokens
        self._hosts = tuple(name.lower() for name in settings.hosts)
        if not settings.hosts and settings.tokens is None:
            self._hosts = LOCAL_NAMES

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        settings, is_upload = self._settings, scope["path"].startswith(UPLOADS)
        body = _Body(receive, settings.recording_bytes if is_upload else settings.body_bytes)
        rest: asyncio.Task[None] | None = None

        async def send_with_headers(message: Message) -> None:
            nonlocal rest
            if message["type"] == "http.response.start":
                rest = asyncio.create_task(body.drop())  # who still sends can read the answer
                await asyncio.wait([rest], timeout=UNREAD_S)
                headers = MutableHeaders(scope=message)
                for name, value in STRICT_HEADERS.items():
                    headers.setdefault(name, value)
                if not rest.done():
                    headers["Connection"] = "close"
            await send(message)

        try:
            self._require_ours(scope, body.most_bytes)
            await self._app(scope, body.receive, send_with_headers)
        except Problem as problem:
            await problem.response(scope, receive, send_with_headers)
        finally:
            if rest is not None:
                rest.cancel()

    def _require_ours(self, scope: Scope, most_bytes: int) -> None:
        headers = Headers(scope=scope)
        host, origin = headers.get("host", ""), headers.get("origin")
        if self._hosts and _split(f"//{host}").hostname not in self._hosts:
            raise Problem(400, "the server is not called by this name; give it with --host-name")
        is_foreign = origin is not None and _split(origin).netloc.lower() != host.lower()
        if scope["method"] not in _SAFE and is_foreign:
            raise Problem(403, "the request comes from a page of another site")
        if scope["path"] != "/healthz":
            require_token(self._tokens, headers.get("authorization", ""))
        length = headers.get("content-length", "0")
        if not length.isdecimal() or int(length) > most_bytes:
            raise _too_large(most_bytes)


class _Body:
    """A body as it arrives, which ends in a problem if it is too large or too slow."""

    def __init__(self, receive: Receive, most_bytes: int) -> None:
        self._receive, self.most_bytes = receive, most_bytes
        self._start_s, self._bytes, self._is_whole = time.monotonic(), 0, False

    async def receive(self) -> Message:
        if self._is_whole:  # what follows is the end of the connection
            return await self._receive()
        end_s = self._start_s + BODY_S + self._bytes / BODY_BYTES_PER_S
        try:
            async with asyncio.timeout(max(0.0, end_s - time.monotonic())):
                message = await self._receive()
        except TimeoutError:
            raise Problem(408, f"the body stopped after {self._bytes} bytes") from None
        self._bytes += len(message.get("body", b""))
        self._is_whole = not message.get("more_body", False)
        if self._bytes > self.most_bytes:
            raise _too_large(self.most_bytes)
        return message

    async def drop(self) -> None:
        """Take what is left, unread: hypercorn waits for ever for room in its queue."""
        while not self._is_whole:
            message = await self._receive()
            self._is_whole = not message.get("more_body", False)


def _too_large(most_bytes: int) -> Problem:
    return Problem(413, f"the body is larger than {most_bytes} bytes; send less")


def _split(url: str) -> SplitResult:
    try:
        return urlsplit(url)
    except ValueError:
        return urlsplit("")


def load_tokens(path: Path) -> Tokens:
    """The hashes in a file, a line each."""
    lines = [line.strip() for line in read_text(path).splitlines()]
    for number, line in enumerate(lines, 1):
        if not _LINE.fullmatch(line):
            expected = "expected a hash, as calibgraph serve --new-token writes"
            raise FileError(path, f"line {number} is {line[:40]!r}, {expected}")
    return frozenset(lines)


def add_token(path: Path) -> str:
    """Make a token, which is kept nowhere, and add its hash to a file, which is made if missing."""
    tokens, secret = load_tokens(path) if path.exists() else (), secrets.token_urlsafe(32)
    write_text(path, "".join(f"{digest}\n" for digest in (*sorted(tokens), _hash(secret))))
    path.chmod(0o600)
    return secret


def _hash(token: str) -> str:
    """SHA-256: a token is 256 random bits, which no one finds by trying, nor by taking the time."""
    return hashlib.sha256(token.encode()).hexdigest()


def require_token(tokens: Tokens | None, authorization: str) -> None:
    """Refuse a caller without a token, of Bearer or the password of Basic."""
    scheme, _, given = authorization.partition(" ")
    if scheme.lower() == "basic":
        with suppress(ValueError):
            given = b64decode(given, validate=True).decode().partition(":")[2]
    if tokens is not None and _hash(given.strip()) not in tokens:
        text = "give a token: Authorization: Bearer TOKEN"
        raise Problem(401, text, {"WWW-Authenticate": _REALM})
