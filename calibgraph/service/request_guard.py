"""What every request passes: the host it names, the page it comes from; strict headers back."""

import time
from collections.abc import Callable
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from calibgraph.service.problems import problem_response

STRICT_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; object-src 'none'; base-uri 'none'; "
    "form-action 'self'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "same-origin",  # without a referrer a form has no Origin
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
    "Cache-Control": "no-store",
}
"""Of every answer that does not set its own."""

LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")
_SAFE = ("GET", "HEAD", "OPTIONS")
_LONGEST_PATH = 2048

Observe = Callable[[str, str, int, float], None]
"""Called with the method, the route, the status and the seconds of each request."""


class RequestGuard:
    """Checks requests before any route, and adds headers to all answers.

    A page of another site that a browser shows could otherwise call a server without tokens: its
    name is then not one of ours, or its ``Origin`` is another one.
    """

    def __init__(self, app: ASGIApp, hosts: tuple[str, ...], observe: Observe) -> None:
        self._app, self._hosts, self._observe = app, hosts, observe

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        start, status = time.perf_counter(), [500]

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                status[0] = message["status"]
                headers = MutableHeaders(scope=message)
                for name, value in STRICT_HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        try:
            refusal = self._refusal(scope)
            if refusal is None:
                await self._app(scope, receive, send_with_headers)
            else:
                await problem_response(*refusal)(scope, receive, send_with_headers)
        finally:
            seconds = time.perf_counter() - start
            self._observe(scope["method"], _route_of(scope), status[0], seconds)

    def _refusal(self, scope: Scope) -> tuple[int, str] | None:
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        if self._hosts and _name_of(host) not in self._hosts:
            return 400, "the server is not called by this name; give it with --host-name"
        origin = headers.get("origin")
        if scope["method"] not in _SAFE and origin is not None and not _is_of(origin, host):
            return 403, "the request comes from a page of another site"
        if len(scope["path"]) > _LONGEST_PATH:
            return 414, f"the path is longer than {_LONGEST_PATH} characters"
        return None


def _name_of(host: str) -> str:
    """The name in a Host header, without its port."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def _is_of(origin: str, host: str) -> bool:
    """Whether a page that calls is one of this server's."""
    try:
        return urlsplit(origin).netloc.lower() == host.lower()
    except ValueError:
        return False


def _route_of(scope: Scope) -> str:
    """The route's pattern: the paths themselves, with their ids, would be too many to count."""
    route = scope.get("route")
    return str(getattr(route, "path", "other"))
