"""The page of a session and the program behind it: a server of this machine.

The page is that of reports. It asks for other clips, sends the values of all sliders and gets a
motion back, and waits for news of a fit that goes on. Nothing is kept for a browser between two
requests, so several can look at once.
"""

import errno
import functools
import http.server
import ipaddress
import json
import re
import socket
import threading
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import jaxik
from fitting.report import live_data, motion_data, pages
from fitting.runtime.validation import Content

from . import edits
from .edits import Tuning
from .session import Session
from .solving import LAYERS, Solved, Solver

MOST_PORTS = 100  # that are tried
MAX_REQUEST = 10_000_000  # bytes
PATIENCE = 20.0  # s, after which a page that waits for news asks again
JSON, HTML, BYTES = "application/json", "text/html; charset=utf-8", "application/octet-stream"
NUMBER = re.compile(r"\d{1,9}")


class News(NamedTuple):
    """A system that a page is to begin with anew."""

    number: int = 0
    name: str = ""
    values: str = ""
    """As the page takes them."""
    note: str = ""


class Viewer:
    """What the page of a session asks for; its methods are called from several threads.

    Args:
        session: what is viewed.
        folder: where Save writes.
    """

    def __init__(self, session: Session, folder: Path):
        self.session, self.folder = session, folder
        self.tuning = Tuning(session)
        self._solvers: dict[int, Solver] = {}
        self._clips: dict[int, Content] = {}
        self._lock = threading.RLock()  # of what computes
        self._news, self._changed = News(), threading.Condition()
        self._ready = threading.Event()
        threading.Thread(target=self._prepare, name="jaxik view: first clip", daemon=True).start()

    def _prepare(self) -> None:
        """Solves the first clip, which compiles, before a browser asks for it."""
        try:
            self.clip(0)
        except (ValueError, RuntimeError):
            pass  # the browser is told, which asks for it again
        finally:
            self._ready.set()

    def page(self, *, wait: bool = False) -> str:
        """The page, with its first clip.

        Args:
            wait: until that is solved; otherwise it is a page meanwhile that asks again.
        """
        session = self.session
        if not self._ready.wait(None if wait else 0.0):
            return pages.render("waiting.html", [], title=session.title)
        first = self.clip(0)
        return pages.render(
            "view.html",
            [first, *[None] * (len(session.clips) - 1)],
            is_remote=True,
            kind="Move parameters, and see the motion",
            title=session.title,
            names=[clip.name for clip in session.clips],
            visible=f"{100 * first['visibleDepth']:.2g} cm",
            stands="captured" if session.clips[0].animation.captured else "animated",
            watched="solved motion",
            layers=LAYERS,
        )

    def clip(self, number: int) -> Content:
        """A clip as the page shows it, with its sliders.

        Raises:
            ValueError: there is no such clip, or its poses are not finite.
        """
        with self._lock:
            if number not in self._clips:
                solver = self._solver(number)
                (content,) = motion_data.pack([solver.viewed()])
                content |= {"live": self.tuning.content()}
                if self.session.reload is not None:
                    clip = solver.clip
                    content["contacts"] = edits.pack_stances(clip.labelled, clip.data)
                self._clips[number] = content
            return self._clips[number]

    def _solver(self, number: int) -> Solver:
        if not 0 <= number < (count := len(self.session.clips)):
            raise ValueError(f"clip {number}; wanted 0 to {count - 1}")
        return self._solvers.setdefault(number, Solver(self.session, number))

    def solve(self, request: Content) -> bytes:
        """A motion for values of all sliders, as the page reads it.

        Raises:
            ValueError: the request lacks something, or the poses are not finite.
        """
        number, layers = _field(request, "clip", int), _field(request, "layers", list)
        with self._lock:
            clip, ik = self.clip(number), self._system(request)
            solved = self._solver(number).solve(ik, [name for name in layers if name in LAYERS])
        return _packed(solved, clip)

    def save(self, request: Content) -> list[str]:
        """Writes the system with these values; says what was written.

        Raises:
            ValueError: the folder cannot be written to.
        """
        session, drop = self.session, _field(request, "drop", bool)
        with self._lock:
            ik = self._system(request)
            return edits.save(self.folder, ik, session.preset, session.leg_length, drop=drop)

    def save_contacts(self, request: Content) -> Content:
        """Writes the stances of a clip; the clip as it is read with them, and a message.

        Raises:
            ValueError: a stance is none, or a file cannot be written or read with them.
        """
        number, legs = _field(request, "clip", int), _field(request, "legs", list)
        with self._lock:
            clip = self._solver(number).clip
            if self.session.reload is None:
                raise ValueError("stances cannot be put right while a fit goes on")
            message = edits.save_contacts(clip.files, clip.labelled, legs)
            self.session = self.session.reload()
            self.tuning = Tuning(self.session)
            self._solvers, self._clips = {}, {}
            return {"clip": self.clip(number), "message": message}

    def _system(self, request: Content) -> jaxik.FootIK:
        return self.tuning.system(live_data.unpacked_doubles(_field(request, "values", str)))

    def restart(self, name: str, ik: jaxik.FootIK, note: str) -> None:
        """Lets pages begin anew with another system, as a fit that goes on finds better ones."""
        values = self.tuning.packed(ik)
        with self._changed:
            self._news = News(self._news.number + 1, name, values, note)
            self._changed.notify_all()

    def news(self, after: int) -> News:
        """What is newer than the news with a number; the same again if nothing comes for long."""
        with self._changed:
            self._changed.wait_for(lambda: self._news.number > after, PATIENCE)
            return self._news


def _field(request: Content, name: str, kind: type) -> Any:
    value = request.get(name)
    if not isinstance(value, kind):
        raise ValueError(f"{name} is {value!r}; wanted {kind.__name__}")
    return value


def _packed(solved: Solved, shown: Content) -> bytes:
    """The length of a JSON text, the text, and after it the arrays that it lists."""
    arrays, step, corner = (
        motion_data.solution(solved.clip, solved.soles, shown),
        shown["step"],
        shown["corner"],
    )
    for name, (points, colours) in solved.layers.items():
        arrays[f"{name} points"] = (points[::step] - corner).astype("<f4")
        arrays[f"{name} colours"] = colours[::step]
    content = {
        "milliseconds": 1e3 * solved.seconds,
        "cost": solved.cost,
        "layers": {name: lines.points.shape[1] for name, lines in solved.layers.items()},
        "arrays": [[name, array.dtype.str[1:], array.size] for name, array in arrays.items()],
    }
    text = json.dumps(content).encode()
    data = b"".join(np.ascontiguousarray(array).tobytes() for array in arrays.values())
    return np.uint32(len(text)).tobytes() + text + data


class Answer(NamedTuple):
    """What a request gets."""

    content: bytes
    kind: str


def _json(content: Any) -> Answer:
    return Answer(json.dumps(content).encode(), JSON)


class Handler(http.server.BaseHTTPRequestHandler):
    """Answers the requests of pages that this server has served, and of no others."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True  # it would wait for 40 ms between two parts of an answer
    server: "Server"

    def do_GET(self) -> None:
        """The page, a clip, or news."""
        viewer, (name, _, number) = self.server.viewer, self.path.strip("/").partition("/")
        if self.path == "/":
            self._answer(lambda: Answer(viewer.page().encode(), HTML))
        elif name == "clip" and NUMBER.fullmatch(number):
            self._answer(lambda: _json(viewer.clip(int(number))))
        elif name == "news" and NUMBER.fullmatch(number):
            self._answer(lambda: _json(viewer.news(int(number))._asdict()))
        else:
            self._refuse(HTTPStatus.NOT_FOUND, f"{self.path}: there is no such page")

    def do_POST(self) -> None:
        """Solves or saves."""
        viewer = self.server.viewer
        actions: Mapping[str, Callable[[Content], Answer]] = {
            "/solve": lambda request: Answer(viewer.solve(request), BYTES),
            "/save": lambda request: _json(viewer.save(request)),
            "/contacts": lambda request: _json(viewer.save_contacts(request)),
        }
        length = int(self.headers.get("Content-Length") or 0)
        if not 0 < length <= MAX_REQUEST:
            self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"a request of {length} bytes")
            return
        body, action = self.rfile.read(length), actions.get(self.path)
        if action is None:
            self._refuse(HTTPStatus.NOT_FOUND, f"{self.path}: there is no such action")
        else:
            self._answer(lambda: action(_request(body)))

    def _answer(self, make: Callable[[], Answer]) -> None:
        if not self._is_own():
            self._refuse(HTTPStatus.FORBIDDEN, "only pages that jaxik view serves here may ask")
            return
        try:
            answer = make()
        except (ValueError, RuntimeError) as error:  # JAX raises the latter without memory
            self._refuse(HTTPStatus.BAD_REQUEST, str(error))
        except Exception:
            traceback.print_exc()
            self._refuse(HTTPStatus.INTERNAL_SERVER_ERROR, "this failed; the terminal says where")
        else:
            self._send(HTTPStatus.OK, *answer)

    def _is_own(self) -> bool:
        """Whether the request comes from a page of this server, by a name of this machine.

        Browsers let any page send requests here, also by a name that its owner has given to this
        machine's address.
        """
        host = self.headers.get("Host", "")
        origin = self.headers.get("Origin")
        names_us = not self.server.is_local or is_loopback(host.rpartition(":")[0] or host)
        return names_us and origin in (None, f"http://{host}")

    def _refuse(self, status: HTTPStatus, reason: str) -> None:
        self.close_connection = True
        self._send(status, reason.encode(), "text/plain; charset=utf-8")

    def _send(self, status: HTTPStatus, content: bytes, kind: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        try:
            self.wfile.write(content)
        except (BrokenPipeError, ConnectionResetError):
            pass  # the page is closed

    def log_message(self, *_: object) -> None:
        """Nothing: the terminal is for what the user wants to know."""


def _request(body: bytes) -> Content:
    content = json.loads(body)
    if not isinstance(content, dict):
        raise ValueError("a request that is not a JSON object")
    return content


def is_loopback(host: str) -> bool:
    """Whether a name or an address is always that of this machine."""
    try:
        return host == "localhost" or ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True)
class Address:
    """Where the page is served."""

    host: str = "127.0.0.1"
    port: int = 8080
    """The next free one is taken where this is in use; 0 for any."""

    @property
    def is_local(self) -> bool:
        """Whether only this machine reaches it."""
        return is_loopback(self.host)


HERE = Address()


class Server(http.server.ThreadingHTTPServer):
    """Serves the page of a viewer until it is closed.

    Args:
        viewer: whose page it is.
        address: where it listens.

    Raises:
        ValueError: there is no such address here, or no free port.
    """

    daemon_threads = True
    allow_reuse_address = False

    def __init__(self, viewer: Viewer, address: Address):
        self.viewer, self.is_local = viewer, address.is_local
        self.address_family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
        super().__init__((address.host, self._free_port(address)), Handler)
        serve = functools.partial(self.serve_forever, poll_interval=0.05)  # s, to notice its end
        threading.Thread(target=serve, name="jaxik view", daemon=True).start()

    def _free_port(self, address: Address) -> int:
        last = min(address.port + MOST_PORTS, 65_535) if address.port else 0
        for port in range(address.port, last + 1):
            try:
                with socket.create_server((address.host, port), family=self.address_family):
                    return port
            except OverflowError as error:
                raise ValueError(f"--port {port}: {error}") from None
            except (OSError, UnicodeError) as error:
                if not _is_in_use(error):
                    words = f"--host {address.host}: no address of this machine: {error}"
                    raise ValueError(words) from None
        raise ValueError(f"--port {address.port}: it and the next {MOST_PORTS} are in use")

    @property
    def url(self) -> str:
        """What to open in a browser."""
        host, port = self.server_address[:2]
        name = "localhost" if host in ("0.0.0.0", "::") else str(host)
        return f"http://{f'[{name}]' if ':' in name else name}:{port}"

    def close(self) -> None:
        """Stops listening."""
        self.shutdown()
        self.server_close()


def _is_in_use(error: Exception) -> bool:
    return isinstance(error, OSError) and error.errno in (errno.EADDRINUSE, errno.EACCES)
