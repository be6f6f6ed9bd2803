"""Access control of the explorer: only pages that it serves itself, on this machine, get an answer.

Every page in the browser can reach a server on loopback. A foreign host name can also point to 127.0.0.1 (DNS
rebinding). So a request must come from this machine and name the explorer as its host. If it states the page that sent
it (`Origin`, as every WebSocket of a browser does), this page must be the explorer's.

Other users of this machine could forge all of this. So the printed address ends in a token. The token is exchanged for
a cookie at once, and requests without the cookie are refused.
"""

import ipaddress
import secrets
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

from starlette.requests import HTTPConnection  # pyright: ignore[reportMissingImports]  # the extra `explore`
from starlette.responses import PlainTextResponse  # pyright: ignore[reportMissingImports]

from diffabs.core.types import Table

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Any]]
Send = Callable[[Any], Awaitable[None]]

LOOPBACK_ADDRESS = "127.0.0.1"
LOOPBACK_NAMES = (LOOPBACK_ADDRESS, "localhost")
HTTP_PORT = 80  # a browser leaves it out of `Host` and `Origin`
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
        self.app = app
        self.hosts = {f"{name}:{port}" for name in LOOPBACK_NAMES}
        self.hosts |= {*LOOPBACK_NAMES} if port == HTTP_PORT else set()
        # A browser sends a cookie to every port of a host, so the port is in its name.
        self.token = token
        self.cookie: str = f"diffabs-explore-{port}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Forward a request, exchange its token for the cookie, or refuse it."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        request = HTTPConnection(scope)
        allowed = self.is_allowed(request)
        if allowed and self._same([request.cookies.get(self.cookie, "")]):
            await self.app(scope, receive, _with_policy(send) if scope["type"] == "http" else send)
        elif scope["type"] == "websocket":
            # A close before the accept refuses the handshake with 403.
            await receive()
            await send({"type": "websocket.close", "code": 1008})
        else:
            answer = PlainTextResponse(f"{STRANGER if allowed else FOREIGN}\n", 403)
            if allowed and self._same(request.query_params.getlist("token")):
                cookie = f"{self.cookie}={self.token}; Path=/; HttpOnly; SameSite=Lax"
                # "/" is the only page. The request's own path may be unsafe: "//name" is a host.
                answer = PlainTextResponse("", 303, {"location": "/", "set-cookie": cookie})
            answer.headers["cache-control"] = "no-store"
            await answer(scope, receive, send)

    def is_allowed(self, request: HTTPConnection) -> bool:
        """Return whether the `request` comes from this machine and names the explorer as its host.

        If the request states the page that sent it, this page must be the explorer's.
        """
        host, origin = (request.headers.getlist(name) for name in ("host", "origin"))
        here = len(host) == 1 and host[0] in self.hosts
        # Requests without Origin pass: a browser omits it for the navigation to the page.
        same_origin = origin in ([], [f"http://{host[0]}"]) if here else False
        return here and same_origin and _loopback(request.client)

    # compare_digest takes the same time for every guess, so timing does not reveal the token.
    def _same(self, tokens: list[str]) -> bool:
        return len(tokens) == 1 and secrets.compare_digest(tokens[0].encode(), self.token.encode())


def _loopback(client: Any) -> bool:
    try:
        return ipaddress.ip_address(client[0]).is_loopback
    except (TypeError, IndexError, ValueError):
        return False


def _with_policy(send: Send) -> Send:
    async def sent(message: Table) -> None:
        if message["type"] == "http.response.start":
            more = [(b"content-security-policy", POLICY.encode()), (b"x-content-type-options", b"nosniff")]
            message = {**message, "headers": [*message.get("headers", []), *more]}
        await send(message)

    return sent
