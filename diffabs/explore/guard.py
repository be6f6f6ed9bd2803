"""Access control of the explorer: only pages that it serves itself, on this machine, get an answer.

Every page in the browser can reach a server on loopback. A foreign host name can also point to 127.0.0.1 (DNS
rebinding). So a request must come from this machine and name the explorer as its host. If it states the page that sent
it (`Origin`, as every WebSocket of a browser does), this page must be the explorer's.

Other users of this machine could forge all of this. So the printed address ends in a token. The token is exchanged for
a cookie at once, and requests without the cookie are refused.
"""

import http.cookies
import ipaddress
import secrets
import urllib.parse
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

from diffabs.core.types import Table

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Any]]
Send = Callable[[Any], Awaitable[None]]

LOOPBACK_ADDRESS = "127.0.0.1"
LOOPBACK_NAMES = (LOOPBACK_ADDRESS, "localhost")
FOREIGN = "diffabs explore answers only its own page"
STRANGER = "diffabs explore: the token is missing or wrong; open the whole address that the command has printed"
# The browser loads nothing from other hosts. Inline scripts are allowed because the framework needs them.
POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self' ws://127.0.0.1:* ws://localhost:*; "
    "frame-ancestors 'none'; base-uri 'self'; form-action 'self'"
)


class Guard:
    """An ASGI application that forwards allowed requests to another application and answers 403 to the rest."""

    def __init__(self, app: Callable[[Scope, Receive, Send], Awaitable[None]], port: int, token: str):
        """Protect `app`, served at `port`, with the secret `token` of its user."""
        self.app, self.hosts = app, {f"{name}:{port}" for name in LOOPBACK_NAMES}
        # A browser sends a cookie to every port of a host, so the port is in its name.
        self.token, self.cookie = token, f"diffabs-explore-{port}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Forward a request, exchange its token for the cookie, or refuse it."""
        if scope["type"] == "lifespan" or (self.is_allowed(scope) and self.is_known(scope)):
            await self.app(scope, receive, _with_policy(send) if scope["type"] == "http" else send)
        elif scope["type"] == "websocket":
            # A close before the accept refuses the handshake with 403.
            await receive()
            await send({"type": "websocket.close", "code": 1008})
        elif not self.is_allowed(scope):
            await _answer(send, 403, FOREIGN)
        elif self._same(urllib.parse.parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [])):
            cookie = f"{self.cookie}={self.token}; Path=/; HttpOnly; SameSite=Lax"
            # "/" is the only page. The request's own path is unsafe: "//name" is a host, a line break ends the header.
            await _answer(send, 303, "", (b"location", b"/"), (b"set-cookie", cookie.encode()))
        else:
            await _answer(send, 403, STRANGER)

    def is_allowed(self, scope: Table) -> bool:
        """Return whether the request with this `scope` comes from this machine and names the explorer as its host.

        If the request states the page that sent it, this page must be the explorer's.
        """
        given = _headers(scope)
        host, origin = given.get(b"host", []), given.get(b"origin", [])
        here = len(host) == 1 and host[0] in self.hosts
        # Requests without Origin pass: a browser omits it for the navigation to the page.
        own = origin in ([], [f"http://{host[0]}"]) if here else False
        return here and own and _loopback(scope.get("client"))

    def is_known(self, scope: Table) -> bool:
        """Return whether the request with this `scope` has the cookie that replaces the token."""
        given = []
        for line in _headers(scope).get(b"cookie", []):
            try:
                found = http.cookies.SimpleCookie(line).get(self.cookie)
            except http.cookies.CookieError:
                continue
            given += [found.value] if found else []
        return self._same(given)

    # compare_digest takes the same time for every guess, so timing does not reveal the token.
    def _same(self, given: list[str]) -> bool:
        return len(given) == 1 and secrets.compare_digest(given[0].encode(), self.token.encode())


def _headers(scope: Table) -> dict[bytes, list[str]]:
    given: dict[bytes, list[str]] = {}
    for name, value in scope["headers"]:
        given.setdefault(name.lower(), []).append(value.decode("latin-1"))
    return given


async def _answer(send: Send, status: int, line: str, *more: tuple[bytes, bytes]) -> None:
    body = f"{line}\n".encode()
    headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"content-length", str(len(body)).encode())]
    headers += [(b"cache-control", b"no-store"), *more]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})


def _loopback(client: Any) -> bool:
    try:
        return ipaddress.ip_address(client[0]).is_loopback
    except (TypeError, IndexError, ValueError):
        return False


def _with_policy(send: Send) -> Send:
    async def sent(message: Any) -> None:
        if message["type"] == "http.response.start":
            more = [(b"content-security-policy", POLICY.encode()), (b"x-content-type-options", b"nosniff")]
            message = {**message, "headers": [*message.get("headers", []), *more]}
        await send(message)

    return sent
