"""The server of the pages, on one address, while a browser is connected; beside a run it is a separate process.

in     {"over": "ended", "folder": ".../runs/x"}      a line from the run, when it is over; the end of the input ends it
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import secrets
import signal
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import count
from pathlib import Path
from typing import Any

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.server.auth_provider import AuthProvider
from bokeh.server.server import Server
from bokeh.server.util import bind_sockets
from pydantic import BaseModel, ConfigDict
from softrig_core import Scenario, ScenarioError, rig_of
from softrig_core.guard import print_line
from softrig_core.verdict.figures import changed_from, evaluate
from softrig_core.verdict.result import Result
from tornado.ioloop import IOLoop
from tornado.web import HTTPError, RequestHandler

from .control import Control
from .page import EVERY, Page, bare
from .remote import Remote
from .sources import Live, Source

SHOWN = 5  # repeated messages about bad requests that are printed; later ones only at powers of ten
LARGEST = 1 << 20  # bytes of one message of a browser; pages send some hundred
LOOPBACK = ("127.0.0.1", "::1", "localhost")
PAGE = "/view"
AWAY = 5000  # ms that a browser may be disconnected, because it may be loading the page again
# s in which a browser answers a ping, or its connection is closed: what is sent to one that was suspended or has lost
# its network would be kept in memory
GONE = 30.0
SHARE = 10.0  # 1/n of the time that the computation of figures may take


class Watched(BaseModel):
    """Data that the process of a page needs about the run beside it.

    Parameters
    ----------
    domain : int
        ROS_DOMAIN_ID.
    directory : str
        Where the nodes write their files.
    how : str
        Mode and place, in words.
    pace : float
        Initial ratio of simulated to wall-clock time; 0: as fast as possible.
    address : str
        ``host:port``; port 0: a free one.
    token : str
        That lets a browser in.
    """

    model_config = ConfigDict(extra="forbid")
    scenario: dict[str, Any]
    domain: int
    directory: str
    realtime: bool
    paused: bool
    pace: float
    how: str
    address: str
    token: str


class OneLine(logging.Filter):
    """Shortens Bokeh's stack trace for an invalid browser message to one line; a flood of them becomes a few lines."""

    def __init__(self) -> None:
        super().__init__()
        self.number = 0

    def filter(self, record: logging.LogRecord) -> bool:
        """Pass a log record without its stack: the first ones, then the 10th, 100th, ... with their number."""
        self.number += 1
        if self.number > SHOWN and str(self.number).strip("0") != "1":
            return False
        self._shorten(record)
        if self.number > SHOWN:
            record.msg, record.args = f"{record.getMessage()} ({self.number} lines like this by now)", ()
        return True

    @staticmethod
    def _shorten(record: logging.LogRecord) -> None:
        error = record.exc_info[1] if record.exc_info else None
        if error is not None:
            record.msg, record.args = "a page sent an invalid message: %s: %.200s", (type(error).__name__, error)
            record.exc_info = record.exc_text = None
        record.msg, record.args = "%.300s", (record.getMessage(),)


class _Token(AuthProvider):  # type: ignore[misc]
    """Admits a browser that has the token in the address of the page; later a cookie carries the token.

    Parameters
    ----------
    names : tuple of str
        Host names under which the page may be requested; empty: any. A foreign host name may also resolve to this host.
    """

    def __init__(self, token: str, names: tuple[str, ...]) -> None:
        self._token, self._names = token, names
        super().__init__()

    @property
    def get_user_async(self) -> Any:  # Bokeh calls it before it answers any request, also for a websocket
        async def user(handler: RequestHandler) -> str:
            if self._names and handler.request.host_name.strip("[]") not in self._names:
                raise HTTPError(403, reason="the page is served to this host only, expected its own address")
            token = handler.get_argument("token", "") or handler.get_cookie("softrig_token", "") or ""
            if not secrets.compare_digest(token.encode(), self._token.encode()):
                raise HTTPError(403, reason="expected the address of the page with its token")
            if handler.get_argument("token", ""):
                handler.set_cookie("softrig_token", self._token, httponly=True, samesite="Strict")
            return "token"

        return user

    @property
    def login_url(self) -> str:
        return "/"  # Bokeh requires it; a refused browser is not redirected


class _ToPage(RequestHandler):
    def get(self) -> None:
        query = f"?{self.request.query}" if self.request.query else ""
        self.redirect(PAGE + query)


def free_address(address: str) -> tuple[str, int]:
    """Return host and port of a page, a free one for port 0.

    Raises
    ------
    ScenarioError
        Nothing can be served there.
    """
    host, _, port = address.rpartition(":")
    host = host.strip("[]") or "127.0.0.1"
    if not port.isdecimal() or int(port) > 65535:
        raise ScenarioError(f"--address {address!r}: expected HOST:PORT, port 0 for a free one")
    try:
        sockets, chosen = bind_sockets(host, int(port))  # the allowed origins of a page contain the port
        for server in sockets:
            server.close()
    except OSError as error:
        raise ScenarioError(f"--address {address}: {error.strerror}") from None
    return host, chosen


def new_token() -> str:
    """Create the token that a browser must send; other users of this host and pages of other origins do not have it."""
    return secrets.token_urlsafe(16)


class Pages:
    """The pages of one source.

    Parameters
    ----------
    how : str
        Mode and place of the run.
    address : str
        ``host:port``.
    token : str
        That lets a browser in.

    Raises
    ------
    ScenarioError
        Nothing can be served there.
    """

    def __init__(self, source: Source, control: Control, how: str, address: str, token: str, loop: IOLoop) -> None:
        self._source, self._control, self._how = source, control, how
        self._numbers = count(1)
        self._results: Sequence[Result] = ()
        self._worker = ThreadPoolExecutor(1)
        self._next, self._busy = 0.0, False
        self.visited = False
        host, chosen = free_address(address)
        reported = OneLine()  # one for all browsers: three lines for each message would be too many
        for name in ("bokeh.server.protocol_handler", "bokeh.server.views.ws", "tornado.application"):
            logging.getLogger(name).addFilter(reported)
        for name in ("bokeh.server.views.ws", "bokeh.server.contexts"):  # a browser may disconnect at any moment
            logging.getLogger(name).setLevel(logging.ERROR)
        if host in LOOPBACK:
            origins = [f"{name}:{chosen}" for name in ("localhost", host)]
        else:  # the token protects the page, so any name of this host is allowed, without Bokeh's warning
            logging.getLogger("bokeh.server.util").setLevel(logging.ERROR)
            origins = ["*"]
        try:
            self.server = Server(
                {PAGE: Application(FunctionHandler(self._page))},
                io_loop=loop,
                address=host,
                port=chosen,
                extra_patterns=[("/", _ToPage)],
                check_unused_sessions_milliseconds=AWAY // 5,
                unused_session_lifetime_milliseconds=AWAY,
                allow_websocket_origin=origins,
                websocket_max_message_size=LARGEST,
                websocket_ping_interval=GONE,
                auth_provider=_Token(token, LOOPBACK if host in LOOPBACK else ()),
            )
        except OSError as error:
            raise ScenarioError(f"--address {address}: {error.strerror}") from None
        shown = f"[{host}]" if ":" in host else host
        self.url = f"http://{shown}:{self.server.port}/?token={token}"
        self.server.start()

    def _page(self, document: Document) -> None:
        arguments = document.session_context.request.arguments if document.session_context else {}
        text = "dark" if arguments.get("look", [b""])[0] == b"dark" else "light"
        number = next(self._numbers)
        author = f"browser {number}"
        try:
            Page(document, self._source, self._control, self._figures, author, self._how, text)
        except Exception as error:  # code of a user's plant or plots may fail; the run can continue without a page
            print_line(f"a page cannot be shown: {type(error).__name__}: {error}")
            document.clear()
            bare(document, self._control, author, error)

    def left(self) -> bool:
        """Update the connections; return whether all browsers have left after at least one has shown a page."""
        sessions = self.server.get_sessions(PAGE)
        # A page that was requested, but has no websocket yet, may belong to a slow machine.
        self.visited = self.visited or any(session.connection_count > 0 for session in sessions)
        return self.visited and not sessions

    def _figures(self) -> tuple[Sequence[Result], bool]:
        if self._source.results:
            stopped = self._source.outcome.startswith("stopped")  # a stopped run is not judged
            return [Result.read(r) for r in self._source.results], stopped
        return self._results, True

    def measure(self) -> None:
        """Measure the figures of the data so far from time to time, in parallel with the pages."""
        source = self._source
        if self._busy or source.results or source.thinned or not source.live or time.monotonic() < self._next:
            return
        self._busy = True
        pane = source.pane(0.0, source.end)
        started = time.monotonic()

        def done(value: Any) -> None:
            self._busy = False
            self._next = time.monotonic() + max(1.0, SHARE * (time.monotonic() - started))
            turned = "the scenario without what was turned" if source.changes else ""
            why = changed_from(source.rig) or turned
            self._results = [result.not_judged(why) for result in value.result()]

        future = self._worker.submit(evaluate, source.rig, pane, under_way=True)
        future.add_done_callback(lambda value: self.server.io_loop.add_callback(done, value))

    def close(self) -> None:
        """Stop the server."""
        self._worker.shutdown(cancel_futures=True)
        self.server.unlisten()  # the sessions end with the process


def serve(source: Source, how: str, address: str) -> None:
    """Show a recording until it is interrupted."""
    loop = IOLoop.current()
    control = Control(source.rig, None, lambda: source.end, lambda: source.outcome)
    pages = Pages(source, control, how, address, new_token(), loop)
    print_line(f"the page is {pages.url}; Ctrl-C ends it")
    try:
        loop.start()
    finally:
        pages.close()


def serve_run(watched: Watched, lines: Any) -> None:
    """Show a run in progress until it has ended and no browser is connected, or until `lines` ends."""
    os.nice(10)  # lower priority than the loop
    rig = rig_of(Scenario.model_validate(watched.scenario))
    loop = IOLoop.current()
    directory = Path(watched.directory)
    source = Live(rig, directory, watched.realtime)
    remote = Remote(watched.domain, directory, loop.add_callback)
    guests = any(m.external for m in rig.members)  # external nodes do not pause with the clock
    held = None if rig.clock.external or (watched.realtime and guests) else watched.paused
    pace = None if watched.realtime else watched.pace
    control = Control(rig, remote.ask, lambda: source.end, lambda: source.outcome, held, pace)
    pages = Pages(source, control, watched.how, watched.address, watched.token, loop)
    print_line(f"the page is {pages.url}")
    reported, paced = 0, (held, pace)

    def refresh() -> None:
        nonlocal reported, paced
        source.read_new()
        now = source.status[control.clock] if held is not None else {}
        known = (now["held"], None if watched.realtime else now["pace"]) if "pace" in now else paced
        if paced != (paced := known):  # the pace has changed, here or elsewhere
            control.held, control.pace = paced
        for change in source.changes[reported:]:
            control.log_change(*change)
        reported = len(source.changes)
        pages.measure()
        if pages.left() and source.outcome:
            loop.stop()

    def over(values: dict[str, Any]) -> None:
        source.finish(values["over"], Path(values["folder"]) if values.get("folder") else None)
        control.add_entry("the run", values["over"], values.get("wrong", False))

    def listen() -> None:
        for line in lines:
            loop.add_callback(over, json.loads(line))
        loop.add_callback(loop.stop)

    from tornado.ioloop import PeriodicCallback

    PeriodicCallback(refresh, EVERY).start()
    threading.Thread(target=listen, daemon=True).start()
    try:
        loop.start()
    finally:
        pages.close()
        remote.close()


def main() -> int:
    """Serve beside a run: one argument, a file with `Watched` as JSON."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run decides when the page ends
    asyncio.set_event_loop(asyncio.new_event_loop())
    try:
        serve_run(Watched.model_validate_json(Path(sys.argv[1]).read_text()), sys.stdin)
    except ScenarioError as error:
        print_line(str(error))
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
