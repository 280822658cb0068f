"""viser's one-file page as the front door serves it: own title, and a content security policy that fits it."""

import base64
import gzip
import hashlib
import re
from dataclasses import dataclass
from pathlib import Path

import viser

QUIET = (
    "<script>addEventListener('unhandledrejection',e=>{if(e.reason instanceof EvalError)e.preventDefault()})</script>"
)
"""viser loads a sorter for Gaussian splats that wants ``eval``. The policy denies it, no splats are drawn here,
and the console stays clean for errors that matter."""
STYLE = "touch.css"
SCRIPTS = (
    "changes.js",
    "presses.js",
    "glossary.js",
    "touch.js",
    "introduction.js",
    "captions.js",
    "opening.js",
    "drops.js",
    "aside.js",
    "hints.js",
    "smooth.js",
    "link.js",
    "numbers.js",
    "names.js",
    "choices.js",
)
"""What numbers the changes of widgets (``app/web/changes.py``), keeps presses beneath which the page moves, reports
presses (``app/web/touch.py``), shows the glossary, the introduction, the captions of the projector view and of phones,
how far the opening of a scene is, sends photographs that are dropped (``app/web/drops.py``), puts a note of viser's and
the hints of controls aside, moves the viewer smoothly, keeps the address (``app/link.py``), mends what is typed into
number boxes, names for screen readers what viser does not, and says what the entries of a list are there for."""


THIS_MACHINE = "http://localhost:* http://127.0.0.1:* https://localhost:* https://127.0.0.1:*"


@dataclass(frozen=True)
class Page:
    """The page and what may run in it."""

    html: bytes
    zipped: bytes
    """The same, gzip compressed."""
    policy: str
    """The content security policy."""


def client_html() -> str:
    """The page of the installed viser as it comes."""
    return (Path(viser.__file__).parent / "client" / "build" / "index.html").read_text(encoding="utf-8")


def load_page(framed: bool = False) -> Page:
    """The page of the installed viser; ``framed`` is one that other pages of this machine may show in a frame."""
    html = client_html()
    own = Path(__file__).parent
    scripts = "".join(f"<script>{own.joinpath(name).read_text(encoding='utf-8')}</script>" for name in SCRIPTS)
    ours = f"{QUIET}<style>{own.joinpath(STYLE).read_text(encoding='utf-8')}</style>{scripts}"
    html = html.replace("<title>Viser</title>", f"<title>spherloc</title>{ours}", 1)
    data = html.encode()
    return Page(html=data, zipped=gzip.compress(data, mtime=0), policy=content_policy(html, framed))


def content_policy(html: str, framed: bool = False) -> str:
    """A policy under which the page runs with no network but this server, and nothing else runs in it.

    - Scripts: the page's own inline loader by its hash, and what that loader inserts; so neither text from a
      scene file nor viser's "run this JavaScript" message can execute anything.
    - Connections: this server only; a link with ``?websocket=`` or ``?playbackPath=`` cannot point elsewhere.
    - No frames but those of this server's lessons, and of this machine if ``framed``: another site cannot lay this page
      under its own buttons.
    """
    scripts = re.findall(r"<script\b[^>]*>(.*?)</script>", html, flags=re.DOTALL)
    hashes = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in scripts]
    rules = {
        "default-src": "'none'",
        "script-src": " ".join(
            [f"'sha256-{digest}'" for digest in hashes] + ["'strict-dynamic'", "'wasm-unsafe-eval'"]
        ),
        "style-src": "'unsafe-inline'",
        "img-src": "'self' data: blob:",
        "font-src": "data:",
        "worker-src": "blob: data:",
        "connect-src": "'self' data: blob:",
        "base-uri": "'none'",
        "form-action": "'none'",
        "frame-ancestors": f"'self' {THIS_MACHINE}" if framed else "'self'",
    }
    return "; ".join(f"{name} {value}" for name, value in rules.items())
