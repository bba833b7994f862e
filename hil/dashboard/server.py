"""The window's process: the page, and a websocket on which every browser gets what it can take. Nobody waits for a slow one.

On the websocket the server sends a list of records (`hil.dashboard.view`) as JSON; the page sends orders,
``{"do": "align"}``. Where a token is wanted, the first message is ``{"token": ...}``. A page of another origin is refused;
so is, without a token, any host name that is not this machine's own, which a foreign page could have pointed here.
"""

import asyncio
import contextlib
import ipaddress
import json
import secrets
from collections.abc import AsyncIterator, Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from hil.dashboard.address import Window
from hil.dashboard.view import FAST_S, SLOW_S, Sources, View

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.types import ASGIApp, Receive, Scope, Send
    from starlette.websockets import WebSocket

STATIC = Path(__file__).parent / "static"
BROWSERS = 16
"""Most pages at a time."""
TOKEN_S = 5.0
"""Time to give the token."""
_REFUSED, _BUSY = 1008, 1013
_HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-cache",
}


def run_dashboard(window: Window, sources: Sources, answer: Connection) -> None:
    """Target of the window's process: serves until the run is over."""
    import uvicorn

    class Server(uvicorn.Server):
        """One that leaves signals alone: the session says when it is over."""

        @contextlib.contextmanager
        def capture_signals(self) -> Iterator[None]:
            yield

    view = View(sources)
    hub = _Hub(view)

    def over() -> None:
        server.should_exit = True

    config = uvicorn.Config(
        application(window, hub, over),
        log_config=None,
        log_level="critical",  # what a stranger sends is no news on our terminal
        limit_concurrency=4 * BROWSERS,
        access_log=False,
        server_header=False,
        ws="websockets-sansio",
        ws_max_size=4096,
        ws_per_message_deflate=False,
        lifespan="on",
        timeout_graceful_shutdown=1,
    )
    server = Server(config)
    server.run(sockets=[window.socket])
    problem = {} if hub.failure is None else {"failed": f"window: {hub.failure}"}
    answer.send({"browsers": hub.browsers, "updates": hub.updates} | problem)


class _Hub:
    """Looks at the run `FAST_S` by `FAST_S`, once for all browsers."""

    def __init__(self, view: View) -> None:
        self.view = view
        self.fast = ""
        self.slow = "{}"
        self.looks = self.slow_number = 0
        self.browsers = self.updates = self.open = 0
        self.failure: BaseException | None = None
        """Why it ended before the run did."""
        self._looked = asyncio.Event()

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        warming = asyncio.create_task(asyncio.to_thread(self.view.warm))
        next_s = slow_s = loop.time()
        ended = False
        while not ended:
            ended = self.view.ended
            self.fast = json.dumps(self.view.fast()) if warming.done() and self.view.look() else ""
            if loop.time() >= slow_s or ended:
                self.slow, self.slow_number = json.dumps(self.view.slow()), self.slow_number + 1
                slow_s = loop.time() + SLOW_S - 0.5 * FAST_S
            self.looks += 1
            looked, self._looked = self._looked, asyncio.Event()
            looked.set()
            next_s = max(next_s + FAST_S, loop.time())
            await asyncio.sleep(next_s - loop.time())
        await warming

    async def next(self) -> None:
        """Until the next look."""
        await self._looked.wait()


def application(window: Window, hub: _Hub, over: Callable[[], None]) -> "Starlette":
    """The page and its websocket."""
    from starlette.applications import Starlette
    from starlette.middleware import Middleware
    from starlette.routing import Mount, WebSocketRoute
    from starlette.staticfiles import StaticFiles

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        looking = asyncio.create_task(hub.run())
        looking.add_done_callback(lambda _: over())
        yield
        await asyncio.wait([looking])
        hub.failure = looking.exception()

    async def live(websocket: "WebSocket") -> None:
        await _serve(websocket, window, hub)

    return Starlette(
        routes=[WebSocketRoute("/live", live), Mount("/", StaticFiles(directory=STATIC, html=True))],
        middleware=[Middleware(_Guard, window=window)],
        lifespan=lifespan,
    )


class _Guard:
    """Refuses foreign host names, and adds the headers that confine the page."""

    def __init__(self, app: "ASGIApp", window: Window) -> None:
        self._app, self._window = app, window

    async def __call__(self, scope: "Scope", receive: "Receive", send: "Send") -> None:
        from starlette.datastructures import Headers, MutableHeaders
        from starlette.responses import PlainTextResponse
        from starlette.websockets import WebSocketClose

        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        host, origin = headers.get("host", ""), headers.get("origin")
        if not self._known(host) or (origin is not None and urlsplit(origin).netloc != host):
            refusal: Any = WebSocketClose(_REFUSED)
            if scope["type"] == "http":
                refusal = PlainTextResponse("this window belongs to another address", 403)
            await refusal(scope, receive, send)
            return

        async def confined(message: Any) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_HEADERS)
            await send(message)

        await self._app(scope, receive, confined)

    def _known(self, host: str) -> bool:
        if self._window.token:
            return True
        try:
            name = urlsplit(f"//{host}").hostname or ""
            return name in ("localhost", self._window.host.lower()) or ipaddress.ip_address(name).is_loopback
        except ValueError:
            return False


async def _serve(websocket: "WebSocket", window: Window, hub: _Hub) -> None:
    """One browser, from its coming to its going."""
    from starlette.websockets import WebSocketDisconnect

    await websocket.accept()
    if hub.open >= BROWSERS:
        await websocket.close(_BUSY, f"{BROWSERS} pages are open already")
        return
    hub.open += 1
    sender = None
    try:
        if window.token and not await _knows(websocket, window.token):
            await websocket.close(_REFUSED, "token")
            return
        hub.browsers += 1
        sender = asyncio.create_task(_send(websocket, hub))
        while True:
            order = _parsed(await websocket.receive_text())
            what, fault = str(order.get("do", "")), str(order.get("fault", ""))
            if what and (why := hub.view.order(what, fault)):
                await websocket.send_text(json.dumps([{"k": "refused", "text": why}]))
    except (WebSocketDisconnect, KeyError):  # KeyError: bytes where text is expected
        pass
    finally:
        hub.open -= 1
        if sender is not None:
            sender.cancel()


async def _knows(websocket: "WebSocket", token: str) -> bool:
    try:
        said = _parsed(await asyncio.wait_for(websocket.receive_text(), TOKEN_S))
    except (TimeoutError, KeyError):
        return False
    return secrets.compare_digest(str(said.get("token", "")).encode(), token.encode())


def _parsed(text: str) -> dict[str, Any]:
    try:
        said = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return said if isinstance(said, dict) else {}


async def _send(websocket: "WebSocket", hub: _Hub) -> None:
    """Send what is new, as fast as the browser takes it: what came between is left out for it."""
    from starlette.websockets import WebSocketDisconnect

    view = hub.view
    told, slow_number = view.told, 0
    records = [json.dumps(view.hello())]
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        while True:
            if hub.slow_number != slow_number:
                slow_number = hub.slow_number
                records.append(hub.slow)
            if hub.fast:
                records.append(hub.fast)
            if view.told > told:
                records += [json.dumps({"k": "event", **event}) for event in view.events if event["n"] > told]
                told = view.told
            if records:
                await websocket.send_text(f"[{','.join(records)}]")
                hub.updates += 1
            records = []
            await hub.next()
