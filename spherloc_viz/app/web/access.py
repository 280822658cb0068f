"""Which requests a server accepts, and what the headers of its answers forbid the browser.

Where a server listens beyond this machine there are two links, each with a token of its own. A token becomes a cookie,
and the browser goes on without it in the address, so that a copied address or a picture of the screen gives nothing
away.
"""

import contextlib
import hmac
import html
import ipaddress
import os
import secrets
import socket
from enum import StrEnum
from html import escape
from urllib.parse import urlencode, urlsplit

from aiohttp import web
from multidict import CIMultiDictProxy

from spherloc.errors import InputError

SAFE = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}
"""Headers of every answer: browsers do not guess its type, and no other site can embed or read it."""

_SORRY = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>spherloc</title><link rel="icon" href="data:,">
<style>html{{color-scheme:light dark}}
body{{font:16px/1.5 system-ui,sans-serif;max-width:40rem;margin:18vh auto;padding:0 1rem;overflow-wrap:anywhere}}
</style></head>
<body><p>{sentence}</p></body></html>
"""
SORRY_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'none'"


def sorry_page(sentence: str) -> str:
    """A plain page with one sentence."""
    return _SORRY.format(sentence=html.escape(sentence))


def open_socket(host: str, port: int) -> socket.socket:
    """A listening socket.

    Raises ``InputError`` if the address cannot be had.
    """
    if not 0 <= port < 2**16:
        raise InputError(f"port {port} does not exist; give --port a number up to 65535, or 0 for any free one.")
    where = f"{host}:{port}"
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        return socket.create_server(address[:2], family=family)
    except socket.gaierror:
        raise InputError(f"'{host}' is not an address of this machine; use --host 127.0.0.1.") from None
    except OSError as error:
        # Python adds its own words to the system's.
        reason = os.strerror(error.errno) if error.errno else str(error)
        raise InputError(f"cannot listen on {where} ({reason}); choose another port with --port.") from None


def is_own_name(netloc: str, host: str) -> bool:
    """Whether a Host header names this server: an IP literal, localhost, or the name that --host gave.

    Only a name can be made to point here by a foreign site (DNS rebinding); an address cannot.
    """
    try:
        name = urlsplit(f"//{netloc}").hostname or ""
    except ValueError:
        return False
    if name in ("localhost", host.lower()):
        return True
    with contextlib.suppress(ValueError):
        ipaddress.ip_address(name)
        return True
    return False


def refusal(headers: CIMultiDictProxy[str], host: str, upgrade: bool) -> str | None:
    """Why a request with these headers is refused, or None if it is welcome."""
    own = headers.getall("Host", [])
    if len(own) != 1 or not is_own_name(own[0], host):
        return "This address is not the playground's: open the address that the command printed."
    origins = headers.getall("Origin", [])
    # A browser sends Origin with every websocket; a request without one is no browser's, and is refused.
    if (upgrade and not origins) or any(origin not in _same_origins(own[0]) for origin in origins):
        return "Another site may not use the playground."
    return None


def _same_origins(netloc: str) -> tuple[str, str]:
    return f"http://{netloc}", f"https://{netloc}"


TOKEN = "token"
"""What the token is called in a link."""
NO_TOKEN = "A token is needed here: open the link that spherloc play printed, or ask the person who started it."
WRONG_TOKEN = (
    "The token in this address is not valid: each start makes new ones, so open the link that spherloc play printed "
    "last, or ask the person who started it."
)

_ENTRY = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>spherloc</title><link rel="icon" href="data:,">
<meta http-equiv="refresh" content="0;url={path}"></head><body><a href="{path}">Open the playground</a></body></html>
"""


class Role(StrEnum):
    """What a page may do."""

    PRESENTER = "presenter"
    """Everything."""
    AUDIENCE = "audience"
    """Look at what the presenter shows: nothing is computed, read or written for it."""


class Access:
    """The tokens of one server. Where none is demanded, everybody is the presenter."""

    def __init__(self, demanded: bool) -> None:
        self._tokens = {role: secrets.token_urlsafe(32) for role in Role} if demanded else {}
        # Browsers do not tell cookies of one machine's ports apart, so each server has a name of its own.
        self._cookie = f"spherloc-{secrets.token_hex(8)}"

    @property
    def demanded(self) -> bool:
        """Whether a token is."""
        return bool(self._tokens)

    def link(self, address: str, role: Role) -> str:
        """The link that lets in, at an address such as http://127.0.0.1:8080."""
        return f"{address}/?{urlencode({TOKEN: self._tokens[role]})}" if self.demanded else address

    def role(self, request: web.Request) -> Role | None:
        """The role that the cookie gives; None without a valid one."""
        return self._role_of(request.cookies.get(self._cookie, "")) if self.demanded else Role.PRESENTER

    def enter(self, request: web.Request) -> web.Response | None:
        """The answer to a link with a token: the cookie, and on to the address without it; None if it is no such link.

        Not a redirect: of a link in a mail or a chat a browser would not send the new cookie along, which is Strict.
        """
        given = request.query.getall(TOKEN, [])
        if not (self.demanded and given and request.method in ("GET", "HEAD")):
            return None
        if len(given) > 1 or self._role_of(given[0]) is None:
            return refused(request, WRONG_TOKEN)
        rest = urlencode([(name, value) for name, value in request.query.items() if name != TOKEN])
        path = "/" + (f"?{rest}" if rest else "")
        headers = SAFE | {"Content-Security-Policy": SORRY_POLICY, "Cache-Control": "no-store"}
        answer = web.Response(text=_ENTRY.format(path=escape(path)), content_type="text/html", headers=headers)
        answer.set_cookie(self._cookie, given[0], path="/", httponly=True, samesite="Strict")
        return answer

    def _role_of(self, given: str) -> Role | None:
        """The role of a token. Every token is compared, each in a time that does not depend on where they differ."""
        shown = given.encode("utf-8", "surrogatepass")
        found = [role for role, token in self._tokens.items() if hmac.compare_digest(shown, token.encode())]
        return found[0] if found else None


def refused(request: web.Request, sentence: str) -> web.Response:
    """A 403 with one sentence, as a page where a browser asks for one."""
    if "text/html" not in request.headers.get("Accept", ""):
        return web.Response(status=403, text=sentence + "\n", headers=SAFE)
    headers = SAFE | {"Content-Security-Policy": SORRY_POLICY, "Cache-Control": "no-store"}
    return web.Response(status=403, text=sorry_page(sentence), content_type="text/html", headers=headers)
