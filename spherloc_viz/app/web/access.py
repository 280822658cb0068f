"""Who a request is from, where a server listens beyond this machine: two links, each with a token of its own.

A link's token becomes a cookie, and the browser goes on without it in the address, so that a copied address or a
picture of the screen gives nothing away.
"""

import hmac
import secrets
from enum import StrEnum
from html import escape
from urllib.parse import urlencode

from aiohttp import web

from spherloc_viz.app.web.guard import SAFE
from spherloc_viz.app.web.viewer import SORRY_POLICY, sorry_page

TOKEN = "token"
"""What the token is called in a link."""
NO_TOKEN = "A token is needed here: open the link that spherloc play printed, or ask whoever started it for one."
WRONG_TOKEN = (
    "The token in this address is not valid: each start makes new ones, so open the link that spherloc play printed "
    "last, or ask whoever started it."
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
        """Who asks, by the cookie; None without a valid one."""
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
        """Whose token it is. Every token is compared, each in a time that does not depend on where they differ."""
        shown = given.encode("utf-8", "surrogatepass")
        found = [role for role, token in self._tokens.items() if hmac.compare_digest(shown, token.encode())]
        return found[0] if found else None


def refused(request: web.Request, sentence: str) -> web.Response:
    """A 403 with one sentence, as a page where a browser asks for one."""
    if "text/html" not in request.headers.get("Accept", ""):
        return web.Response(status=403, text=sentence + "\n", headers=SAFE)
    headers = SAFE | {"Content-Security-Policy": SORRY_POLICY, "Cache-Control": "no-store"}
    return web.Response(status=403, text=sorry_page(sentence), content_type="text/html", headers=headers)
