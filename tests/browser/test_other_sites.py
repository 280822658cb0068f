"""What a page of another site can do to the playground: nothing."""

import re
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from playground import blind_page
from playwright.sync_api import Browser, Page

OPEN_SOCKET = """address => new Promise(done => {
    const socket = new WebSocket(address, ["viser-v1.1.1"]);
    socket.onopen = () => done("open");
    socket.onerror = () => done("refused");
})"""
READ = "address => fetch(address).then(() => 'read', () => 'refused')"
FRAME = """address => new Promise(done => {
    const frame = document.createElement("iframe");
    frame.src = address;
    frame.onload = () => setTimeout(() => done(frame.contentDocument ? "own" : "foreign"), 200);
    document.body.append(frame);
})"""


class Blank(BaseHTTPRequestHandler):
    """A site with an empty page."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(b"<!doctype html><title>a stranger</title><body></body>")

    def log_message(self, format: str, *args: object) -> None:
        """Nothing to say."""


@pytest.fixture
def stranger(browser: Browser) -> Iterator[Page]:
    """A tab on another site of this machine, the closest that a stranger can come."""
    site = ThreadingHTTPServer(("127.0.0.1", 0), Blank)
    threading.Thread(target=site.serve_forever, daemon=True).start()
    page = browser.new_context().new_page()
    page.goto(f"http://localhost:{site.server_port}/")
    yield page
    page.context.close()
    site.shutdown()
    site.server_close()


def test_another_site_cannot_use_the_playground(stranger: Page, address: str) -> None:
    assert stranger.evaluate(OPEN_SOCKET, address.replace("http:", "ws:")) == "refused"
    assert stranger.evaluate(READ, address) == "refused"


def test_another_site_cannot_frame_the_playground(stranger: Page, address: str) -> None:
    """So it cannot lay its own buttons over the page's either."""
    stranger.evaluate(FRAME, address)
    # A frame that is refused shows an error page of the browser, in which nothing of ours runs.
    (inner,) = stranger.main_frame.child_frames
    inner.wait_for_url(re.compile("^chrome-error:"), wait_until="commit")


def test_a_name_that_was_made_to_point_here_is_refused(browser: Browser, address: str) -> None:
    """DNS rebinding: to the browser the page and the socket are then of one origin."""
    page = browser.new_context().new_page()
    response = page.request.get(address, headers={"Host": "rebound.example"})
    assert response.status == 403 and "address" in response.text()
    page.context.close()


def test_nothing_leaves_the_page(browser: Browser, address: str) -> None:
    """Neither to another server nor as code that a message could bring."""
    page = blind_page(browser)
    page.goto(address)
    assert page.evaluate(READ, "http://127.0.0.1:9/") == "refused"
    assert page.evaluate(OPEN_SOCKET, "ws://127.0.0.1:9/") == "refused"
    code = "() => new Promise(done => setTimeout(() => { try { eval('1'); done('ran') } catch { done('refused') } }))"
    assert page.evaluate(code) == "refused"
    page.context.close()


def test_a_link_cannot_bring_a_foreign_scene(browser: Browser, address: str) -> None:
    page = blind_page(browser)
    page.goto(f"{address}/?playbackPath=data:application/octet-stream;base64,AAAA&websocket=ws://127.0.0.1:9")
    assert page.url == f"{address}/"
    page.context.close()
