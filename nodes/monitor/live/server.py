"""Web server of the live page: on the loopback interface only, with its own files only, for those
who know its token.
"""

import contextlib
import hmac
import json
import math
import os
import resource
import socket
import threading
import time
from collections.abc import Callable, Iterator
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import SplitResult, parse_qs, urlsplit

from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.process.control import is_shallow

from .feed import Feed
from .notices import Notices
from .stream import StreamReader

ADDRESS = "127.0.0.1"
MAX_PAGES = 64
"""Most pages open at once; each has a stream, and each stream a thread."""
MAX_CONNECTIONS = 4 * MAX_PAGES
SPARE_FILES = 16
"""File descriptors that connections leave to the rest of the process."""
MAX_BODY_BYTES = 4096
SEND_BUFFER_BYTES = 256 * 1024
"""Send buffer of a stream: small, so that a slow page gets recent frames."""
STALLED_S = 30.0
"""A page that accepts no data for this time is disconnected."""
REQUEST_S = 10.0
"""Longest time from the end of one answer to the end of the next, however it is dripped."""
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
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)

TEXTS = ("id", "node", "command")
"""Fields of a request that are texts; a fourth one, `value`, may be anything."""

Request = Callable[[dict[str, Any]], None]


class PageServer(ThreadingHTTPServer):
    """Serves the pages of a feed on `port`, or on a free port if that is busy.

    `ask` takes requests {id, node, command, value} of pages. Whoever asks for anything shows
    `token`, in the address or in the cookie that this leaves; "": no token. Raises SparseskinError
    if no port is free.
    """

    daemon_threads = True
    block_on_close = False
    # A busy port must be refused, not shared; and one just left may be taken again.
    allow_reuse_address = True
    allow_reuse_port = False
    request_queue_size = 128

    def __init__(
        self, feed: Feed, notices: Notices, port: int, ask: Request, token: str = ""
    ) -> None:
        try:
            super().__init__((ADDRESS, port), _Handler)
        except OSError:
            # The port is busy, as by another graph.
            try:
                super().__init__((ADDRESS, 0), _Handler)
            except OSError as error:
                raise SparseskinError(
                    f"the page has no port on {ADDRESS}: {error.strerror}"
                ) from error
        self.feed = feed
        self.notices = notices
        self.ask = ask
        self.token = token
        # Read once: no request reaches the file system.
        self.files = {
            f"/{path.name}": (path.read_bytes(), TYPES[path.suffix])
            for path in PAGE.iterdir()
            if path.suffix in TYPES
        }
        self.files["/"] = self.files["/index.html"]
        self.port = int(self.server_address[1])
        self.url = f"http://{ADDRESS}:{self.port}/"
        if token:
            self.url += f"?token={token}"

        self._lock = threading.Condition()
        self._due_s: dict[socket.socket, float] = {}
        self.n_streams = 0

        # Threads and files are those of the whole process.
        open_files = len(os.listdir("/proc/self/fd")) + SPARE_FILES
        free = resource.getrlimit(resource.RLIMIT_NOFILE)[0] - open_files
        # At least a page, its stream and its files.
        self._max_connections = max(4, min(MAX_CONNECTIONS, free))
        self.max_pages = min(MAX_PAGES, self._max_connections // 2)

        thread = threading.Thread(
            target=self.serve_forever, args=(POLL_S,), daemon=True
        )
        thread.start()

    def close(self) -> None:
        """Send the end to the pages, wait at most 1 s for them, and stop."""
        # Streams end by themselves once the feed is closed.
        self.feed.update(closed=True)
        with self._lock:
            self._lock.wait_for(lambda: not self.n_streams, 1.0)
        self.shutdown()
        self.socket.close()

    def get_request(self) -> tuple[socket.socket, Any]:
        try:
            return super().get_request()
        except OSError:
            # No file descriptor is left: not to be tried again at once.
            self._end_oldest()
            time.sleep(POLL_S)
            raise

    def process_request(self, request: Any, client_address: Any) -> None:
        # Whoever opens too many connections ends its oldest one.
        if len(self._due_s) >= self._max_connections:
            self._end_oldest()
        self.expect(request, REQUEST_S)
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            with self._lock:
                self._due_s.pop(request, None)

    def expect(self, connection: socket.socket, within_s: float) -> None:
        """End a connection unless it is done, or expected anew, within this time."""
        with self._lock:
            # Put behind the others: the first one is then the oldest.
            self._due_s.pop(connection, None)
            self._due_s[connection] = time.monotonic() + within_s

    def service_actions(self) -> None:
        """End the connections whose time is over."""
        now_s = time.monotonic()
        with self._lock:
            for connection, due_s in self._due_s.items():
                if due_s <= now_s:
                    _end(connection)

    def _end_oldest(self) -> None:
        """End the connection that has waited longest: whoever holds all of them locks none out."""
        with self._lock:
            # Streams, which have no end of their own, are counted elsewhere.
            for connection, due_s in self._due_s.items():
                if due_s < math.inf:
                    del self._due_s[connection]
                    _end(connection)
                    return

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore broken connections: they are no fault of the graph."""

    @contextlib.contextmanager
    def stream(self) -> Iterator[None]:
        """Count an open stream, or refuse it if there are too many."""
        with self._lock:
            if self.n_streams >= self.max_pages:
                raise _RefusedError(
                    HTTPStatus.SERVICE_UNAVAILABLE,
                    f"{self.max_pages} pages are open already; close one of them",
                )
            self.n_streams += 1
        try:
            yield
        finally:
            with self._lock:
                self.n_streams -= 1
                self._lock.notify_all()


def _end(connection: socket.socket) -> None:
    """Wake the thread that reads from or writes to a connection; it closes the connection."""
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


def _is_equal(text: str, token: str) -> bool:
    # In a time that depends on no character: a token cannot be guessed one by one.
    candidate = text.encode(errors="replace")
    return hmac.compare_digest(candidate, token.encode())


class _RefusedError(Exception):
    def __init__(self, status: HTTPStatus, text: str) -> None:
        super().__init__(text)
        self.status = status


class _ForbiddenError(_RefusedError):
    def __init__(self, text: str) -> None:
        super().__init__(HTTPStatus.FORBIDDEN, text)


def _is_request(body: Any) -> bool:
    """True for a request of a page."""
    if not isinstance(body, dict):
        return False
    for key in TEXTS:
        text = body.get(key)
        if not isinstance(text, str) or len(text) > 64:
            return False
    return is_shallow(body.get("value"))


class _Handler(BaseHTTPRequestHandler):
    server: PageServer

    protocol_version = "HTTP/1.1"
    _cookie = ""

    def handle_one_request(self) -> None:
        self.server.expect(self.connection, REQUEST_S)
        super().handle_one_request()

    def do_GET(self) -> None:
        # As that of a POST, its body must not be parsed as the next request.
        if "Content-Length" in self.headers or "Transfer-Encoding" in self.headers:
            self.close_connection = True
        self._answer(self._get)

    def do_POST(self) -> None:
        # An unread body must not be parsed as the next request.
        self.close_connection = True
        self._answer(self._post)

    def _answer(self, action: Callable[[SplitResult], None]) -> None:
        try:
            self._check_local()
            try:
                url = urlsplit(self.path)
            except ValueError:
                raise _RefusedError(
                    HTTPStatus.BAD_REQUEST, "malformed address"
                ) from None
            self._check_token(url)
            action(url)
        except _RefusedError as refusal:
            self.close_connection = True
            text = f"{refusal}\n".encode()
            self._send(refusal.status, text, "text/plain; charset=utf-8")

    def _get(self, url: SplitResult) -> None:
        if url.path == "/stream":
            # None: the overview of all patches.
            (patch, *_) = parse_qs(url.query).get("patch", [None])
            self._stream(patch)
        elif url.path in self.server.files:
            body, kind = self.server.files[url.path]
            self._send(HTTPStatus.OK, body, kind)
        else:
            raise _RefusedError(HTTPStatus.NOT_FOUND, f"nothing is at {url.path[:64]}")

    def _post(self, url: SplitResult) -> None:
        if url.path != "/request":
            raise _RefusedError(HTTPStatus.NOT_FOUND, "requests go to /request")
        # Without a length, the end of the body is not known.
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal():
            raise _RefusedError(HTTPStatus.LENGTH_REQUIRED, "Content-Length is missing")
        if len(length) > 9 or int(length) > MAX_BODY_BYTES:
            raise _RefusedError(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
                f"at most {MAX_BODY_BYTES} bytes are allowed",
            )
        # A form of another site cannot send this type.
        if self.headers.get_content_type() != "application/json":
            raise _RefusedError(
                HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "expected application/json"
            )

        try:
            request = json.loads(self.rfile.read(int(length)))
        except (ValueError, RecursionError):
            request = None
        if not _is_request(request):
            raise _RefusedError(
                HTTPStatus.BAD_REQUEST, "expected {id, node, command, value} as JSON"
            )
        # Nothing else of it is passed on.
        asked = {key: request.get(key) for key in (*TEXTS, "value")}
        self.server.ask(asked)
        self._send(HTTPStatus.ACCEPTED, b"", "text/plain")

    def log_message(self, *args: Any) -> None:
        """Log nothing: the terminal is for the graph."""

    def version_string(self) -> str:
        return "sparseskin"

    def _check_local(self) -> None:
        """Refuse requests that another site makes a browser send: a foreign Host or Origin."""
        # By a name of its own that leads here, another site could read the answers.
        host = self.headers.get("Host", "")
        name = host
        if ":" in host and not host.endswith("]"):
            name = host.rpartition(":")[0]
        if name not in HOSTS:
            raise _ForbiddenError(f"Host {host[:64]!r} is not this page's")

        # A browser states from which site a request comes.
        origin = self.headers.get("Origin")
        if origin is not None and origin != f"http://{host}":
            raise _ForbiddenError(f"Origin {origin[:64]!r} is not this page's")

        # A link of another site may open the page itself, nothing else.
        site = self.headers.get("Sec-Fetch-Site")
        is_ours = site in (None, "same-origin", "none")
        if not is_ours and self.path.partition("?")[0] != "/":
            raise _ForbiddenError("asked for by a page of another site")

    def _check_token(self, url: SplitResult) -> None:
        """Refuse who shows the token neither in the address nor in the page's cookie."""
        token = self.server.token
        if not token:
            return
        name = f"sparseskin-{self.server.port}"
        (in_address, *_) = parse_qs(url.query).get("token", [""])
        tokens = [in_address, *self._cookies(name)]

        # All are compared: the time to an answer says nothing of which one fits.
        equal = [_is_equal(text, token) for text in tokens]
        if not any(equal):
            raise _ForbiddenError(
                "this page asks for a token: open the address that the graph has "
                "printed"
            )
        # The files of the page are asked for without it.
        if in_address:
            self._cookie = f"{name}={token}; Path=/; HttpOnly; SameSite=Strict"

    def _cookies(self, name: str) -> Iterator[str]:
        """Values of the cookies of a name."""
        for part in self.headers.get("Cookie", "").split(";"):
            key, _, value = part.strip().partition("=")
            if key == name:
                yield value

    def _stream(self, patch: str | None) -> None:
        feed = self.server.feed
        if patch is not None and patch not in feed.patches:
            raise _RefusedError(
                HTTPStatus.NOT_FOUND,
                f"no patch {patch[:64]!r} (known: {', '.join(feed.patches)})",
            )
        with self.server.stream():
            # The stream has no end of its own: only a stalled page is disconnected.
            self.connection.setsockopt(
                socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES
            )
            self.connection.settimeout(STALLED_S)
            self.server.expect(self.connection, math.inf)
            self.close_connection = True
            self.send_response(HTTPStatus.OK)
            self._headers("application/octet-stream")
            self.send_header("Connection", "close")
            self.end_headers()
            with contextlib.suppress(OSError):
                reader = StreamReader(feed, self.server.notices, patch)
                for data in reader.records():
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
        self.send_header("X-Frame-Options", "DENY")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("Referrer-Policy", "no-referrer")
        if self._cookie:
            self.send_header("Set-Cookie", self._cookie)
