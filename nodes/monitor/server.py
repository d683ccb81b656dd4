"""The web server of the live page: on the loopback interface alone, files of its own alone."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import parse_qs, urlsplit

from sparseskin.nodes.control import is_shallow
from sparseskin.nodes.errors import SparseskinError

from .feed import Feed
from .notices import Notices
from .stream import StreamReader

ADDRESS = "127.0.0.1"
MAX_PAGES = 64
"""Most pages open at once; each has a stream, and each stream a thread."""
MAX_CONNECTIONS = 4 * MAX_PAGES
MAX_BODY_BYTES = 4096
SEND_BUFFER_BYTES = 256 * 1024
"""What may wait for a page that does not read: with a small buffer it is seldom behind."""
STALLED_S = 30.0
IDLE_S = 10.0
POLL_S = 0.25
"""How long the server takes, at the most, to notice that it is to end."""
HOSTS = ("127.0.0.1", "localhost", "[::1]")
PAGE = Path(__file__).parent / "page"
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
}
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'"
)

Request = Callable[[dict[str, Any]], None]


class PageServer:
    """Serves the page of a feed.

    Parameters
    ----------
    feed : Feed
        What the pages show.
    notices : Notices
        What is wrong.
    port : int
        Port to take; another, free one where it is busy.
    ask : callable
        Takes a request {id, node, command, value}.

    Raises
    ------
    SparseskinError
        If no port can be had.
    """

    def __init__(self, feed: Feed, notices: Notices, port: int, ask: Request) -> None:
        files = {
            f"/{path.name}": (path.read_bytes(), TYPES[path.suffix])
            for path in PAGE.iterdir()
            if path.suffix in TYPES
        }
        files["/"] = files["/index.html"]
        parts = {"feed": feed, "notices": notices, "ask": ask, "files": files}
        handler = type("Handler", (_Handler,), parts)
        try:
            self._server = _server(port, handler)
        except OSError as error:
            raise SparseskinError(f"the page has no port on {ADDRESS}: {error.strerror}") from error
        self.url = f"http://{ADDRESS}:{self._server.server_address[1]}/"
        self._feed = feed
        self._thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": POLL_S}, daemon=True
        )
        self._thread.start()

    def has(self, port: int) -> bool:
        """Whether it serves at that port."""
        return bool(self._server.server_address[1] == port)

    def close(self) -> None:
        """Tell the pages that this is the end, and give them a moment to hear it."""
        self._feed.tell(closed=True)
        self._server.wait_for_streams(1.0)
        self._server.shutdown()
        self._server.socket.close()


def _server(port: int, handler: type[BaseHTTPRequestHandler]) -> _Server:
    try:
        return _Server((ADDRESS, port), handler)
    except OSError:
        return _Server((ADDRESS, 0), handler)


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    # A busy port must be refused, not shared; and one just left may be taken again.
    allow_reuse_address = True
    allow_reuse_port = False
    request_queue_size = 128

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._lock = threading.Condition()
        self._n_connections = 0
        self.n_streams = 0

    def process_request(self, request: Any, client_address: Any) -> None:
        with self._lock:
            refused = self._n_connections >= MAX_CONNECTIONS
            self._n_connections += not refused
        if refused:
            with contextlib.suppress(OSError):
                request.settimeout(0.1)
                request.sendall(b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\n\r\n")
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            with self._lock:
                self._n_connections -= 1

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A connection that breaks is no fault of the graph's."""

    @contextlib.contextmanager
    def stream(self) -> Any:
        """Count a stream while it lasts; gives whether there is room for it."""
        with self._lock:
            room = self.n_streams < MAX_PAGES
            self.n_streams += room
        try:
            yield room
        finally:
            with self._lock:
                self.n_streams -= room
                self._lock.notify_all()

    def wait_for_streams(self, limit_s: float) -> None:
        with self._lock:
            self._lock.wait_for(lambda: not self.n_streams, limit_s)


class _Handler(BaseHTTPRequestHandler):
    feed: ClassVar[Feed]
    notices: ClassVar[Notices]
    ask: ClassVar[Request]
    files: ClassVar[dict[str, tuple[bytes, str]]]
    server: _Server

    protocol_version = "HTTP/1.1"
    timeout = IDLE_S

    def do_GET(self) -> None:
        if not self._is_local():
            return
        try:
            url = urlsplit(self.path)
        except ValueError:
            self._refuse(HTTPStatus.BAD_REQUEST, "that is no address")
            return
        if url.path == "/stream":
            self._stream(parse_qs(url.query).get("patch", [None])[0])
        elif url.path in self.files:
            body, kind = self.files[url.path]
            self._send(HTTPStatus.OK, body, kind)
        else:
            self._refuse(HTTPStatus.NOT_FOUND, f"nothing is at {url.path[:64]}")

    def do_POST(self) -> None:
        self.close_connection = True  # a body that is not read must not be taken for a request
        if not self._is_local():
            return
        if self.path != "/request":
            self._refuse(HTTPStatus.NOT_FOUND, "requests go to /request")
            return
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal():
            self._refuse(HTTPStatus.LENGTH_REQUIRED, "Content-Length is missing")
            return
        if len(length) > 9 or int(length) > MAX_BODY_BYTES:
            self._refuse(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"at most {MAX_BODY_BYTES} bytes are allowed"
            )
            return
        if self.headers.get_content_type() != "application/json":
            self._refuse(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "expected application/json")
            return
        try:
            request = json.loads(self.rfile.read(int(length)))
        except (ValueError, RecursionError):
            request = None
        fields = ("id", "node", "command")
        if (
            not isinstance(request, dict)
            or not all(
                isinstance(request.get(key), str) and len(request[key]) <= 64 for key in fields
            )
            or not is_shallow(request.get("value"))
        ):
            self._refuse(HTTPStatus.BAD_REQUEST, "expected {id, node, command, value} as JSON")
            return
        type(self).ask({key: request.get(key) for key in (*fields, "value")})
        self._send(HTTPStatus.ACCEPTED, b"", "text/plain")

    def log_message(self, *args: Any) -> None:
        """The terminal is for the graph."""

    def version_string(self) -> str:
        return "sparseskin"

    def _is_local(self) -> bool:
        """Refuse what another site makes a browser ask: a foreign Host or Origin."""
        host = self.headers.get("Host", "")
        name = host.rpartition(":")[0] if not host.endswith("]") and ":" in host else host
        origin = self.headers.get("Origin")
        if name not in HOSTS:
            self._refuse(HTTPStatus.FORBIDDEN, f"Host {host[:64]!r} is not this page's")
        elif origin is not None and origin != f"http://{host}":
            self._refuse(HTTPStatus.FORBIDDEN, f"Origin {origin[:64]!r} is not this page's")
        else:
            return True
        return False

    def _stream(self, patch: str | None) -> None:
        if patch is not None and patch not in self.feed.patches:
            known = ", ".join(self.feed.patches)
            self._refuse(HTTPStatus.NOT_FOUND, f"no patch {patch[:64]!r} (known: {known})")
            return
        with self.server.stream() as room:
            if not room:
                self._refuse(
                    HTTPStatus.SERVICE_UNAVAILABLE,
                    f"{MAX_PAGES} pages are open already; close one of them",
                )
                return
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
            self.connection.settimeout(STALLED_S)
            self.close_connection = True
            self.send_response(HTTPStatus.OK)
            self._headers("application/octet-stream")
            self.send_header("Connection", "close")
            self.end_headers()
            with contextlib.suppress(OSError):
                for data in StreamReader(self.feed, self.notices, patch).records():
                    self.connection.sendall(data)

    def _refuse(self, status: HTTPStatus, text: str) -> None:
        self.close_connection = True
        self._send(status, f"{text}\n".encode(), "text/plain; charset=utf-8")

    def _send(self, status: HTTPStatus, body: bytes, kind: str) -> None:
        self.send_response(status)
        self._headers(kind)
        self.send_header("Content-Length", str(len(body)))
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(body)

    def _headers(self, kind: str) -> None:
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", POLICY)
        self.send_header("X-Content-Type-Options", "nosniff")
