"""Web server of the live page: on the loopback interface only, with its own files only."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
from collections.abc import Callable, Iterator
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import parse_qs, urlsplit

from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.process.control import is_shallow

from .feed import Feed
from .notices import Notices
from .stream import StreamReader

ADDRESS = "127.0.0.1"
MAX_PAGES = 64
"""Most pages open at once; each has a stream, and each stream a thread."""
MAX_CONNECTIONS = 4 * MAX_PAGES
MAX_BODY_BYTES = 4096
SEND_BUFFER_BYTES = 256 * 1024
"""Send buffer of a stream: small, so that a slow page gets recent frames."""
STALLED_S = 30.0
"""A page that accepts no data for this time is disconnected."""
IDLE_S = 10.0
"""A connection without a request for this time is closed."""
POLL_S = 0.25
"""Longest time until the server notices that it is to end."""
HOSTS = ("127.0.0.1", "localhost", "[::1]")
PAGE = Path(__file__).parent.parent / "page"
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
    """Serves the pages of a feed on `port`, or on a free port if that is busy.

    `ask` takes requests {id, node, command, value} of pages. Raises SparseskinError if no port is
    free.
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
            self._server = _Server((ADDRESS, port), handler)
        except OSError:
            self._server = _free_server(handler)
        self.port = int(self._server.server_address[1])
        self.url = f"http://{ADDRESS}:{self.port}/"
        self._feed = feed
        self._thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": POLL_S}, daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Send the end to the pages, wait at most 1 s for them, and stop."""
        self._feed.update(closed=True)
        self._server.wait_for_streams(1.0)
        self._server.shutdown()
        self._server.socket.close()


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
        """Ignore broken connections: they are no fault of the graph."""

    @contextlib.contextmanager
    def stream(self) -> Iterator[None]:
        """Count an open stream, or refuse it if there are too many."""
        with self._lock:
            if self.n_streams >= MAX_PAGES:
                text = f"{MAX_PAGES} pages are open already; close one of them"
                raise _RefusedError(HTTPStatus.SERVICE_UNAVAILABLE, text)
            self.n_streams += 1
        try:
            yield
        finally:
            with self._lock:
                self.n_streams -= 1
                self._lock.notify_all()

    def wait_for_streams(self, limit_s: float) -> None:
        with self._lock:
            self._lock.wait_for(lambda: not self.n_streams, limit_s)


def _free_server(handler: type[BaseHTTPRequestHandler]) -> _Server:
    try:
        return _Server((ADDRESS, 0), handler)
    except OSError as error:
        raise SparseskinError(f"the page has no port on {ADDRESS}: {error.strerror}") from error


class _RefusedError(Exception):
    def __init__(self, status: HTTPStatus, text: str) -> None:
        super().__init__(text)
        self.status = status


class _Handler(BaseHTTPRequestHandler):
    feed: ClassVar[Feed]
    notices: ClassVar[Notices]
    ask: ClassVar[Request]
    files: ClassVar[dict[str, tuple[bytes, str]]]
    server: _Server

    protocol_version = "HTTP/1.1"
    timeout = IDLE_S

    def do_GET(self) -> None:
        self._answer(self._get)

    def do_POST(self) -> None:
        self.close_connection = True  # an unread body must not be parsed as the next request
        self._answer(self._post)

    def _answer(self, action: Callable[[], None]) -> None:
        try:
            self._check_local()
            action()
        except _RefusedError as refusal:
            self.close_connection = True
            text = f"{refusal}\n".encode()
            self._send(refusal.status, text, "text/plain; charset=utf-8")

    def _get(self) -> None:
        try:
            url = urlsplit(self.path)
        except ValueError:
            raise _RefusedError(HTTPStatus.BAD_REQUEST, "malformed address") from None
        if url.path == "/stream":
            self._stream(parse_qs(url.query).get("patch", [None])[0])
        elif url.path in self.files:
            body, kind = self.files[url.path]
            self._send(HTTPStatus.OK, body, kind)
        else:
            raise _RefusedError(HTTPStatus.NOT_FOUND, f"nothing is at {url.path[:64]}")

    def _post(self) -> None:
        if self.path != "/request":
            raise _RefusedError(HTTPStatus.NOT_FOUND, "requests go to /request")
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal():
            raise _RefusedError(HTTPStatus.LENGTH_REQUIRED, "Content-Length is missing")
        if len(length) > 9 or int(length) > MAX_BODY_BYTES:
            raise _RefusedError(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"at most {MAX_BODY_BYTES} bytes are allowed"
            )
        if self.headers.get_content_type() != "application/json":
            raise _RefusedError(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "expected application/json")
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
            raise _RefusedError(
                HTTPStatus.BAD_REQUEST, "expected {id, node, command, value} as JSON"
            )
        type(self).ask({key: request.get(key) for key in (*fields, "value")})
        self._send(HTTPStatus.ACCEPTED, b"", "text/plain")

    def log_message(self, *args: Any) -> None:
        """Log nothing: the terminal is for the graph."""

    def version_string(self) -> str:
        return "sparseskin"

    def _check_local(self) -> None:
        """Refuse requests that another site makes a browser send: a foreign Host or Origin."""
        host = self.headers.get("Host", "")
        name = host.rpartition(":")[0] if not host.endswith("]") and ":" in host else host
        origin = self.headers.get("Origin")
        if name not in HOSTS:
            raise _RefusedError(HTTPStatus.FORBIDDEN, f"Host {host[:64]!r} is not this page's")
        if origin is not None and origin != f"http://{host}":
            raise _RefusedError(HTTPStatus.FORBIDDEN, f"Origin {origin[:64]!r} is not this page's")

    def _stream(self, patch: str | None) -> None:
        if patch is not None and patch not in self.feed.patches:
            known = ", ".join(self.feed.patches)
            raise _RefusedError(HTTPStatus.NOT_FOUND, f"no patch {patch[:64]!r} (known: {known})")
        with self.server.stream():
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
