"""Who may ask a server of ours, and what every answer forbids the browser."""

import contextlib
import ipaddress
import os
import socket
from urllib.parse import urlsplit

from multidict import CIMultiDictProxy

from spherloc.errors import InputError

SAFE = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}
"""Headers of whatever is served: nothing is taken for what it is not, and no other site can embed or read it."""


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
        raise InputError(f"'{host}' is no address of this machine; use --host 127.0.0.1.") from None
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
    # A browser sends Origin with every websocket; none at all is no browser, and no business of this server.
    if (upgrade and not origins) or any(origin not in _same_origins(own[0]) for origin in origins):
        return "Another site may not use the playground."
    return None


def _same_origins(netloc: str) -> tuple[str, str]:
    return f"http://{netloc}", f"https://{netloc}"
