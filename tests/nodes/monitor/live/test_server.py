"""The page's server over real sockets: its own files, its own page's requests, and no others."""

import contextlib
import json
import socket
from http.client import HTTPConnection
from urllib.parse import urlsplit

import pytest
from conftest import wait_until
from feeds import Graph, read_records

from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.monitor.live import server
from sparseskin.nodes.monitor.live.notices import Notices
from sparseskin.nodes.monitor.live.server import (
    MAX_BODY_BYTES,
    MAX_CONNECTIONS,
    MAX_PAGES,
    PAGE,
    PageServer,
)
from sparseskin.nodes.monitor.node import Monitor, MonitorSettings
from sparseskin.nodes.node import Context

TOKEN = "t0k-_n" * 6
GOOD = {"id": "1", "node": "sensor", "command": "pause", "value": True}


class Site:
    """A served page, who reads it, and what it was asked to pass on."""

    def __init__(self, *patches, port=0, token=""):
        self.graph = Graph(*patches)
        self.asked = []
        notices = Notices(self.graph.feed)
        self.page = PageServer(self.graph.feed, notices, port, self.asked.append, token)
        self.host = urlsplit(self.page.url).netloc
        self._clients = []

    def send(self, method, path, body=None, **headers):
        """One request with exactly these headers; "_" in a name stands for "-"."""
        client = HTTPConnection(self.host, timeout=60.0)
        self._clients.append(client)
        client.putrequest(
            method, path, skip_host="Host" in headers, skip_accept_encoding=True
        )
        for name, value in headers.items():
            client.putheader(name.replace("_", "-"), value)
        client.endheaders(body)
        return client.getresponse()

    def post(self, body=None, **headers):
        body = json.dumps(GOOD).encode() if body is None else body
        given = {
            "Content_Type": "application/json",
            "Content_Length": str(len(body)),
        } | headers
        return self.send("POST", "/request", body, **given).status

    def connect(self, sent=""):
        """A connection on which these characters were sent."""
        host, _, port = self.host.partition(":")
        made = socket.create_connection((host, int(port)), timeout=60.0)
        self._clients.append(made)
        made.sendall(sent.encode())
        return made

    def close(self):
        for client in self._clients:
            client.close()
        self.page.close()
        self.page.shutdown()  # the process goes on, so the thread has to end


@pytest.fixture(scope="module")
def site():
    with contextlib.closing(Site()) as site:
        yield site


@pytest.fixture
def make():
    with contextlib.ExitStack() as stack:
        yield lambda *patches, **k: stack.enter_context(
            contextlib.closing(Site(*patches, **k))
        )


@pytest.fixture
def asked(site):
    site.asked.clear()
    return site.asked


def test_every_file_of_the_page_is_served_as_it_is(site):
    names = [path.name for path in PAGE.iterdir()]
    assert {"index.html", "main.js", "style.css", "icon.svg"} <= set(names)
    for name in names:
        response = site.send("GET", f"/{name}")
        assert response.status == 200
        assert response.read() == (PAGE / name).read_bytes()
        assert response.headers["X-Content-Type-Options"] == "nosniff"
        for rule in ("default-src 'none'", "frame-ancestors 'none'"):
            assert rule in response.headers["Content-Security-Policy"]
    assert site.send("GET", "/").read() == (PAGE / "index.html").read_bytes()
    assert (
        site.send("GET", "/main.js")
        .headers["Content-Type"]
        .startswith("text/javascript")
    )


@pytest.mark.parametrize(
    "path",
    [
        *(
            "/../server.py",
            "/%2e%2e/server.py",
            "//etc/passwd",
            "/server.py",
            "/index.html/",
        ),
        *("/index.html%00", "/%69ndex.html", "/..\\server.py", "/request"),
    ],
)
def test_nothing_else_can_be_got(site, path):
    response = site.send("GET", path)
    assert response.status == 404
    assert response.read().startswith(b"nothing is at /")


@pytest.mark.parametrize("host", ["127.0.0.1.evil.example", "10.0.0.1", "", "::1"])
def test_a_name_that_is_not_this_hosts_own_is_refused(site, host):
    for path in ("/", "/stream", "/main.js"):
        response = site.send("GET", path, Host=host)
        assert response.status == 403
        assert f"Host {host!r} is not this page's" in response.read().decode()
    for own in ("localhost", "127.0.0.1", "[::1]", "localhost:1", "[::1]:1"):
        assert site.send("GET", "/", Host=own).status == 200


def test_a_request_of_the_page_is_passed_on(site, asked):
    assert site.post() == 202
    assert site.post(Origin=f"http://{site.host}") == 202
    extra = json.dumps({**GOOD, "value": {"m": 4}, "more": "not passed on"}).encode()
    assert site.post(extra) == 202
    no_value = json.dumps(
        {key: GOOD[key] for key in ("id", "node", "command")}
    ).encode()
    assert site.post(no_value, Content_Type="application/json; charset=utf-8") == 202
    assert asked == [GOOD, GOOD, {**GOOD, "value": {"m": 4}}, {**GOOD, "value": None}]


@pytest.mark.parametrize(
    ("status", "headers"),
    [
        (403, {"Host": "evil.example"}),
        (403, {"Origin": "http://127.0.0.1:1"}),
        (403, {"Origin": "null"}),
        (415, {"Content_Type": "text/plain"}),
        (411, {"Content_Length": "-1"}),
        (413, {"Content_Length": str(MAX_BODY_BYTES + 1)}),
    ],
)
def test_a_request_of_another_site_or_size_is_refused(site, asked, status, headers):
    assert site.post(**headers) == status
    assert asked == []


@pytest.mark.parametrize(
    "body",
    [
        *(b"", b"{", b"[]", b"3", b"null", b'"text"', b"\xff\xfe", b"[" * 4000),
        *(json.dumps({**GOOD, "node": node}).encode() for node in (3, "x" * 65)),
        json.dumps({key: GOOD[key] for key in ("id", "command")}).encode(),
    ],
)
def test_a_body_that_is_no_request_is_refused(site, asked, body):
    assert site.post(body) == 400
    assert asked == []


def test_who_knows_no_token_gets_nothing_and_is_obeyed_in_nothing(make):
    site = make(token=TOKEN)
    port = site.host.partition(":")[2]
    for shown in ("", "x", TOKEN[:-1], f"{TOKEN}x", "%ff%00", "ä"):
        cookie = f"other=1; sparseskin-{port}={shown}".encode().decode("latin-1")
        for path in ("/", "/main.js", "/stream", "/stream?patch=skin", "/nothing"):
            both = "&" if "?" in path else "?"
            assert site.send("GET", path, Cookie=cookie).status == 403
            wrong = site.send(
                "GET", f"{path}{both}token={shown if shown.isascii() else 'x'}"
            )
            assert wrong.status == 403
            assert wrong.headers["Set-Cookie"] is None
            assert b"open the address that the graph has printed" in wrong.read()
        assert site.post(Cookie=cookie) == 403
    assert site.asked == []


def test_the_address_with_its_token_leaves_a_cookie_that_opens_all(make):
    site = make(token=TOKEN)
    assert urlsplit(site.page.url).query == f"token={TOKEN}"
    opened = site.send("GET", f"/?token={TOKEN}")
    assert opened.status == 200
    assert opened.read() == (PAGE / "index.html").read_bytes()
    value, *flags = opened.headers["Set-Cookie"].split("; ")
    assert value == f"sparseskin-{site.host.partition(':')[2]}={TOKEN}"
    assert set(flags) == {"HttpOnly", "SameSite=Strict", "Path=/"}
    for path in ("/", "/main.js", "/stream"):
        assert site.send("GET", path, Cookie=f"other=1; {value}").status == 200
    assert site.post(Cookie=value) == 202
    assert site.asked == [GOOD]


def test_what_a_page_of_another_site_asks_for_is_refused(site, asked):
    origin = "same-site"
    for path in ("/stream", "/main.js"):
        assert site.send("GET", path, Sec_Fetch_Site=origin).status == 403
        assert site.send("GET", path, Sec_Fetch_Site="same-origin").status == 200
    assert site.post(Sec_Fetch_Site=origin) == 403
    assert asked == []
    assert site.post(Sec_Fetch_Site="same-origin") == 202
    # a link to the page
    assert site.send("GET", "/", Sec_Fetch_Site=origin).status == 200


@pytest.mark.parametrize("length", ["Content-Length: {}", "Transfer-Encoding: chunked"])
def test_a_request_hidden_in_the_body_of_another_is_not_executed(site, asked, length):
    body = json.dumps(GOOD)
    head = f"POST /request HTTP/1.1\r\nHost: {site.host}\r\nContent-Type: application/json\r\n"
    hidden = f"{head}Content-Length: {len(body)}\r\n\r\n{body}"
    stated = length.format(len(hidden))
    outer = f"GET / HTTP/1.1\r\nHost: {site.host}\r\n{stated}\r\n\r\n{hidden}"
    assert site.connect(outer).makefile("rb").read().count(b"HTTP/1.1") == 1
    assert asked == []


def test_a_request_that_drips_is_given_up(make, monkeypatch):
    monkeypatch.setattr(server, "REQUEST_S", 0.05)
    drips = make().connect("GET / HTTP/1.1\r\nHost: ")

    def is_ended():
        with contextlib.suppress(OSError):
            drips.sendall(b"x")
            return False
        return True

    wait_until(is_ended, "the end of a connection that sends a byte now and then")


def test_whoever_holds_all_connections_locks_nobody_out(make):
    site = make()
    held = [site.connect("G") for _ in range(MAX_CONNECTIONS + 20)]
    assert site.send("GET", "/").status == 200
    assert site.post() == 202
    assert held[0].recv(1) == b""


def test_a_browser_is_started_without_the_token_in_its_arguments(monkeypatch, tmp_path):
    opened = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr("webbrowser.open", lambda url: bool(opened.append(url)) or True)
    page = tmp_path / "7.0.html"
    page.write_text("left by a monitor that was killed")
    context = Context(
        *("monitor", ManualClock()),
        ask=lambda request: None,
        page_token=TOKEN,
        page_file=str(page),
    )
    monitor = Monitor(MonitorSettings(port=0, browser=True), context)
    monitor.start()
    (path,) = tmp_path.iterdir()
    assert opened == [path.as_uri()]
    assert path.stat().st_mode & 0o777 == 0o600
    assert f"/?token={TOKEN}" in path.read_text()
    monitor.close({})
    assert not path.exists()


def test_the_stream_of_a_patch_brings_its_frames_until_the_end(make):
    site = make()
    site.graph.skin()
    site.graph.frame()
    response = site.send("GET", "/stream?patch=skin")
    assert response.status == 200
    records = read_records(response.read)
    header, arrays = next(record for record in records if record[0]["kind"] == "maps")
    assert header["patch"] == "skin"
    assert set(arrays) == {"taxels", "truth", "reconstruction", "measurements"}
    unknown = site.send("GET", "/stream?patch=foot")
    assert unknown.status == 404
    assert unknown.read() == b"no patch 'foot' (known: skin)\n"
    site.page.close()
    *_, (last, _) = records
    assert last["kind"] == "state"
    assert last["closed"]


def test_no_more_than_64_pages_are_open_at_once(make):
    site = make()
    streams = [site.send("GET", "/stream") for _ in range(MAX_PAGES)]
    assert {stream.status for stream in streams} == {200}
    refused = site.send("GET", "/stream")
    assert refused.status == 503
    assert MAX_PAGES == 64
    assert refused.read() == b"64 pages are open already; close one of them\n"
    streams[7].close()
    site._clients[7].close()
    wait_until(
        lambda: site.send("GET", "/stream").status == 200, "the room of a closed page"
    )


def test_where_the_port_is_busy_another_is_taken(make):
    with socket.create_server(("127.0.0.1", 0)) as other:
        busy = other.getsockname()[1]
        site = make(port=busy)
        assert site.host.startswith("127.0.0.1:")
        assert site.host != f"127.0.0.1:{busy}"
        assert site.send("GET", "/").status == 200
