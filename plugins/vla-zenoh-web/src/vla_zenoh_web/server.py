"""The server of the page: static files, two WebSockets for each page, ``/stop`` and ``/metrics``.

``/control`` carries state and requests, ``/pictures`` pictures alone, so that a picture on a slow
link holds up neither a stop nor the echo of a tick. A page proves who it is by a token in its first
message: there is no cookie that a foreign page could make a browser send.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import secrets
import time
from collections import Counter, deque
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.requests import Request as HttpRequest
from starlette.responses import Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect
from vla_zenoh_teleop.policy import OperatorInput

from vla_zenoh.errors import CodecError, SecurityError, VlaZenohError
from vla_zenoh.lab.rate_limit import RateLimit
from vla_zenoh.types import Event
from vla_zenoh_web import metrics, requests
from vla_zenoh_web.access import People, Person, host_is_ours, origin_is_ours, with_headers
from vla_zenoh_web.arm import surroundings
from vla_zenoh_web.pictures import PageView, Pictures
from vla_zenoh_web.requests import AnyRequest, name_of, parse
from vla_zenoh_web.robot_link import RobotLink
from vla_zenoh_web.tables import node_table, noted_event

STATIC = Path(__file__).parent / "static"
FILES = {
    "/": ("page.html", "text/html; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
}
GONE = (WebSocketDisconnect, RuntimeError)
"""How the end of a browser shows; RuntimeError: Starlette, sent after the end."""
STATE_S, NODES_S, PEOPLE_S = 0.05, 1.0, 1.0
ENTER_S, DENIED_S = 5.0, 0.5
"""A wrong token is answered this late."""
STOP_AGAIN_S = 0.1
MAX_PAGES, MAX_ANSWERS, MAX_NEWS = 32, 200, 300
MAX_WAITING = 8
"""Requests of one page that wait for the robot, in turn."""
RATE_HZ, BURST = 50.0, 100.0
"""Requests of one page; a stop is always taken."""
PICTURE_POLL_S = 0.01
POLICY_VIOLATION, TRY_LATER = 1008, 1013
NOT_HERE = (requests.EnterRequest, requests.LookRequest, requests.DrawnRequest)
"""The first request of a socket, and those of the socket for images."""
SHOWN_OUT = "you are no longer among the people of this page, or your role has changed"
OPERATORS_ONLY = "your token is a viewer's, which may look and nothing else"


class Page:
    """One open page: what waits to be sent to it."""

    def __init__(self, number: int, person: Person, socket: WebSocket) -> None:
        self.number, self.person, self.socket = number, person, socket
        self.limit = RateLimit(RATE_HZ, BURST, time.monotonic())
        self.complaints = RateLimit(5.0, 10.0, time.monotonic())
        self.answers: deque[str] = deque(maxlen=MAX_ANSWERS)
        self.turn, self.waiting = asyncio.Lock(), 0
        self.changed = asyncio.Event()

    def tell(self, message: dict[str, Any]) -> None:
        """Send a message as soon as the connection takes it; the oldest give way."""
        self.answers.append(json.dumps(message))
        self.changed.set()


class PageServer:
    """Application of the page of one robot. `names`: of this server, for the header ``Host``."""

    def __init__(
        self, link: RobotLink, people: People, names: Iterable[str], *, secure: bool
    ) -> None:
        self._link, self._people = link, people
        self._names, self._secure = tuple(names), secure
        self._pictures = Pictures(link.client, link.profile.cameras)
        self._pages: dict[int, Page] = {}
        self._news: deque[dict[str, Any]] = deque(maxlen=MAX_NEWS)
        self._state = ""
        self._looking: dict[WebSocket, Person] = {}
        self._next = 0
        self.counters: Counter[str] = link.counters
        # Stops have threads of their own: those of other requests may all be waiting.
        self._stops = ThreadPoolExecutor(2, thread_name_prefix="stop")
        self._stopping: asyncio.Future[dict[str, Any]] | None = None
        self._stop_s = 0.0
        self._tasks: set[asyncio.Task[Any]] = set()
        routes = [
            *(Route(path, self._file) for path in FILES),
            Route("/favicon.ico", lambda _: Response(status_code=204)),
            Route("/metrics", self._metrics),
            Route("/stop", self._stop_by_post, methods=["POST"]),
            WebSocketRoute("/control", self._control),
            WebSocketRoute("/pictures", self._show_pictures),
        ]
        self._application = Starlette(routes=routes, lifespan=self._lifespan)

    # -- access -------------------------------------------------------------------------------
    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """ASGI: rejects foreign hosts and origins before anything else."""
        if scope["type"] not in ("http", "websocket"):
            await self._application(scope, receive, send)
            return
        headers = {
            name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]
        }
        host, origin = headers.get("host", ""), headers.get("origin", "")
        why = ""
        if not host_is_ours(host, self._names):
            why = f"this server is not called {host[:100]!r}: start it with --name"
        elif (scope["type"] == "websocket" or scope["method"] != "GET") and not origin_is_ours(
            origin, host, secure=self._secure
        ):
            why = "another site's page must not use this one"
        if not why:
            await self._application(scope, receive, with_headers(send))
            return
        self.counters["foreign"] += 1
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": POLICY_VIOLATION})
            return
        response = Response(f"{why}\n", 403, media_type="text/plain")
        await response(scope, receive, with_headers(send))

    async def _person(self, token: str) -> Person | None:
        person = self._people.find(token)
        if person is None:
            self.counters["denied"] += 1
            await asyncio.sleep(DENIED_S)
        return person

    async def _bearer(self, request: HttpRequest) -> Person | None:
        kind, _, token = request.headers.get("authorization", "").partition(" ")
        return await self._person(token.strip() if kind.lower() == "bearer" else "")

    # -- HTTP ---------------------------------------------------------------------------------
    async def _file(self, request: HttpRequest) -> Response:
        name, kind = FILES[request.url.path]
        return Response((STATIC / name).read_bytes(), headers={"content-type": kind})

    async def _metrics(self, request: HttpRequest) -> Response:
        if await self._bearer(request) is None:
            return Response("send a token of this page: Authorization: Bearer TOKEN\n", 401)
        text = metrics.exposition(self._link.rows(), self.counters, len(self._pages))
        return Response(text, headers={"content-type": metrics.CONTENT_TYPE_LATEST})

    async def _stop_by_post(self, request: HttpRequest) -> Response:
        """The way of a page whose WebSocket is broken."""
        person = await self._bearer(request)
        if person is None or not person.drives:
            return Response(OPERATORS_ONLY if person else "no such token", 403)
        return Response(json.dumps(await self._stop(person)), media_type="application/json")

    # -- state --------------------------------------------------------------------------------
    @contextlib.asynccontextmanager
    async def _lifespan(self, _: Any) -> AsyncIterator[None]:
        task = asyncio.create_task(self._watch())
        try:
            yield
        finally:
            task.cancel()
            for page in list(self._pages):
                self._link.release(page, gone=True)
            self._stops.shutdown(wait=False)

    async def _watch(self) -> None:
        nodes_s, people_s = 0.0, time.monotonic()
        while True:
            now_s = time.monotonic()
            self._link.poll()
            if now_s - people_s > PEOPLE_S:
                people_s = now_s
                self._reread_people()
            for event in self._link.client.pop_events():
                news = noted_event(*event)
                self._news.append(news)
                self._tell_all(news)
            if self._pages:
                state = {**self._link.state(), "arms": self._link.arms(), "people": self._here()}
                self._state = json.dumps(state)[1:]
                if now_s - nodes_s > NODES_S:
                    nodes_s = now_s
                    self._tell_all(self._node_message())
                    self._tell_all({"is": "recording", **self._link.recordings.described()})
                for page in self._pages.values():
                    page.changed.set()
            await asyncio.sleep(max(0.0, now_s + STATE_S - time.monotonic()))

    def _reread_people(self) -> None:
        """Show out who is no longer in the file; their hold ends, and the arm brakes."""
        try:
            if not self._people.reread():
                return
        except SecurityError as error:
            why = f"{error}. Who was in it before still may"
            self._link.client.note("web", Event("warning", "notice", "people", why))
            return
        for page in self._pages.values():
            if not self._people.has(page.person):
                self._link.release(page.number, gone=True)
                page.person = page.person._replace(role="viewer")  # whatever is on its way
                self._begin(_show_out(page.socket))
        for socket, person in self._looking.items():
            if not self._people.has(person):
                self._begin(_show_out(socket))

    def _here(self) -> list[dict[str, Any]]:
        """Who has a page open, by name, and who of them holds the arm."""
        found: dict[str, dict[str, Any]] = {}
        for page in self._pages.values():
            person = page.person
            entry = {"name": person.name, "role": person.role, "pages": 0, "holds": False}
            entry = found.setdefault(person.name, entry)
            entry["pages"] += 1
            entry["holds"] = entry["holds"] or self._link.holds(page.number)
        return sorted(found.values(), key=lambda one: str(one["name"]))

    def _node_message(self) -> dict[str, Any]:
        return {"is": "nodes", **node_table(self._link.client), "counters": dict(self.counters)}

    def _tell_all(self, message: dict[str, Any]) -> None:
        for page in self._pages.values():
            page.tell(message)

    # -- the control socket -------------------------------------------------------------------
    async def _enter(
        self, socket: WebSocket, pages: Callable[[], int], *, viewers: bool
    ) -> Person | None:
        """Who is there, by the first message; None: the socket was closed.

        Args:
            pages: number of those that have such a socket now.
            viewers: whether they may have one.
        """
        await socket.accept()
        try:
            request = parse(await asyncio.wait_for(_receive(socket), ENTER_S))
            token = request.token if isinstance(request, requests.EnterRequest) else ""
        except (CodecError, TimeoutError):
            token = ""
        person = await self._person(token)
        if person is None:
            await socket.send_text(json.dumps({"is": "denied", "why": "no such token"}))
        rejected = person is None or not (viewers or person.drives)
        if rejected or pages() >= MAX_PAGES:
            await socket.close(POLICY_VIOLATION if rejected else TRY_LATER)
            return None
        return person

    async def _control(self, socket: WebSocket) -> None:
        with contextlib.suppress(*GONE):
            person = await self._enter(socket, lambda: len(self._pages), viewers=True)
            if person is None:
                return
            self._next += 1
            page = self._pages[self._next] = Page(self._next, person, socket)
            sending = asyncio.create_task(self._send_state(page, socket))
            try:
                self._welcome(page)
                while True:
                    await self._read(page, await _receive(socket))
            finally:
                self._link.release(page.number, gone=True)
                del self._pages[page.number]
                sending.cancel()

    def _welcome(self, page: Page) -> None:
        link = self._link
        page.tell(
            {
                "is": "welcome",
                "robot": link.keys.robot,
                "person": page.person.name,
                "drives": page.person.drives,
                "pictures": self._pictures.offered if page.person.drives else (),
                "surroundings": surroundings(link.profile),
                "no_arm": link.no_arm,
                "insecure": link.profile.session.insecure,
                "levels": link.hand.speeds_m_s,
            }
        )
        for news in self._news:
            page.tell(news)
        page.tell(self._node_message())

    async def _send_state(self, page: Page, socket: WebSocket) -> None:
        with contextlib.suppress(*GONE):
            while True:
                await page.changed.wait()
                page.changed.clear()
                while page.answers:
                    await socket.send_text(page.answers.popleft())
                if not self._state:
                    continue
                tick, holds = int(time.monotonic() * 1e3), self._link.holds(page.number)
                start = json.dumps({"is": "state", "tick": tick, "you_hold": holds})
                await socket.send_text(f"{start[:-1]}, {self._state}")

    async def _read(self, page: Page, text: str) -> None:
        try:
            request = parse(text)
        except CodecError as error:
            self._complain(page, "bad_message", str(error))
            return
        what = name_of(request)
        if isinstance(request, NOT_HERE):
            self._complain(page, "bad_message", f"{what} is no request of this socket now")
            return
        if isinstance(request, requests.PressRequest) and request.tick > time.monotonic() * 1e3:
            why = f"{what}: tick is newer than the last one sent"
            self._complain(page, "bad_message", why)
            page.tell({"is": "hold_ended", "press": request.press, "why": why})
            return
        if not page.limit.take(time.monotonic()) and not isinstance(request, requests.StopRequest):
            self._complain(page, "too_fast", f"more than {RATE_HZ:g} messages per second")
            return
        self.counters["message"] += 1
        if not page.person.drives:
            self._complain(page, "not_allowed", OPERATORS_ONLY)
            return
        await self._obey(page, request)

    def _complain(self, page: Page, what: str, why: str) -> None:
        """Count a message that is not obeyed, and answer it, unless they are very many."""
        self.counters[what] += 1
        if page.complaints.take(time.monotonic()):
            page.tell({"is": "rejected", "what": what, "why": why})

    # -- requests -----------------------------------------------------------------------------
    async def _obey(self, page: Page, request: AnyRequest) -> None:
        link, name = self._link, page.person.name
        match request:
            case requests.StopRequest():
                self._begin(self._stop(page.person))
            case requests.HoldRequest():
                self._press(page, request, lambda: link.activate_held(page.number, request, name))
            case requests.PrimitivePress():
                self._press(page, request, lambda: link.primitive(page.number, request, name))
            case requests.BeatRequest():
                hand = OperatorInput(request.twist, request.opening)
                if not link.beat(page.number, request.press, request.tick, hand):
                    page.tell({"is": "hold_ended", "press": request.press})
            case requests.ReleaseRequest():
                link.release(page.number)
            case requests.InviteRequest():
                self._invite(page, request)
            case requests.SettingRequest():
                self._change(page, name_of(request), lambda: link.set(page.number, request))

    def _invite(self, page: Page, request: requests.InviteRequest) -> None:
        """Tell this page alone the token of the new person, and every page the name."""
        token = secrets.token_urlsafe(24)
        try:
            person = self._people.invite(request.name, request.role, token)
        except VlaZenohError as error:
            why = {"what": name_of(request), "press": 0, "why": str(error), "reasons": []}
            page.tell({"is": "failed", **why})
            return
        page.tell({"is": "invited", **person._asdict()})
        why = f"{page.person.name} lets {person.name} in, as {person.role}"
        self._link.client.note("web", Event("info", "notice", "invited", why))

    def _press(self, page: Page, request: requests.PressRequest, call: Callable[[], Any]) -> None:
        """Begin a hold, and `call` with it."""
        try:
            self._link.press(page.number, request.press, request.tick)
        except VlaZenohError as error:
            page.tell({"is": "hold_ended", "press": request.press, "why": str(error)})
            return
        self._change(page, name_of(request), call, request.press)

    def _change(self, page: Page, what: str, call: Callable[[], Any], press: int = 0) -> None:
        """Run what waits for the robot on a thread, in turn for each page, and tell its end."""
        if page.waiting >= MAX_WAITING:
            self._complain(page, "busy", f"{page.waiting} requests of this page are waiting")
            if press:
                self._link.release(page.number)
            return
        page.waiting += 1

        async def run() -> None:
            answer: dict[str, Any] = {"is": "done", "what": what, "press": press}
            # To deactivate waits for nothing.
            turn = contextlib.nullcontext() if what == "deactivate" else page.turn
            try:
                async with turn:
                    found = await asyncio.to_thread(call)
                if isinstance(found, str):
                    answer["text"] = found
            except VlaZenohError as error:
                first, *reasons = str(error).split("\n  - ")
                answer |= {"is": "failed", "why": first.rstrip(":"), "reasons": reasons}
            finally:
                page.waiting -= 1
            page.tell(answer)

        self._begin(run())

    async def _stop(self, person: Person) -> dict[str, Any]:
        """Stop the robot; all that are asked for while one is confirmed share its report."""
        self.counters["stop"] += 1
        now_s = time.monotonic()
        if self._stopping is None or self._stopping.done():
            self._stopping = asyncio.ensure_future(self._stop_and_tell(person))
            self._stop_s = now_s
        elif now_s - self._stop_s > STOP_AGAIN_S:  # it may have been reset meanwhile
            self._stops.submit(self._link.client.stop)
            self._stop_s = now_s
        return await asyncio.shield(self._stopping)

    async def _stop_and_tell(self, person: Person) -> dict[str, Any]:
        """Stop the robot, and tell every page who did, and when it stood."""
        report = await asyncio.get_running_loop().run_in_executor(self._stops, self._link.stop)
        report = {"is": "stopped", "by": person.name, **report}
        self._tell_all(report)
        return report

    def _begin(self, work: Awaitable[Any]) -> None:
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    # -- the socket of pictures ---------------------------------------------------------------
    async def _show_pictures(self, socket: WebSocket) -> None:
        with contextlib.suppress(*GONE):
            # As `security.roles`: pictures show people.
            person = await self._enter(socket, lambda: len(self._looking), viewers=False)
            if person is None:
                return
            self._looking[socket] = person
            look = PageView(time.monotonic())
            sending = asyncio.create_task(self._send_pictures(look, socket))
            try:
                while True:
                    if fault := look.read(await _receive(socket), self._pictures, time.monotonic()):
                        self.counters[fault] += 1
            finally:
                del self._looking[socket]
                sending.cancel()
                self._pictures.change(look.streams, ())

    async def _send_pictures(self, look: PageView, socket: WebSocket) -> None:
        """Send the newest picture of each stream, as fast as asked and as the page draws them."""
        with contextlib.suppress(*GONE):
            while True:
                for name in look.due(time.monotonic(), self._pictures):
                    picture = await asyncio.to_thread(self._pictures.newest, name)
                    if picture is None:
                        continue
                    look.sent += 1
                    head = {
                        "name": name,
                        "frame": look.sent,
                        "stamp_ms": picture.stamp_wall_ns // 1_000_000,
                        "said": picture.said,
                    }
                    self.counters["picture"] += 1
                    self.counters["picture_bytes"] += len(picture.jpeg)
                    await socket.send_bytes(json.dumps(head).encode() + b"\n" + picture.jpeg)
                await asyncio.sleep(PICTURE_POLL_S)


async def _show_out(socket: WebSocket) -> None:
    with contextlib.suppress(*GONE):
        await socket.send_text(json.dumps({"is": "denied", "why": SHOWN_OUT}))
        await socket.close(POLICY_VIOLATION)


async def _receive(socket: WebSocket) -> str:
    """The next text of a browser. Raises WebSocketDisconnect: it is gone."""
    message = await socket.receive()
    if message["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(message.get("code") or 1006)
    return message.get("text") or ""  # bytes are no request, and neither is ""
