"""The page that opens a recording in Rerun's viewer, the page that says why not, and the policies of both."""

import base64
import hashlib
import html
from functools import cache
from pathlib import Path
from string import Template
from urllib.parse import quote

from spherloc_viz.recording.run_row import RunRow

PROGRAM = "/viewer/program/"
DATA = "/viewer/data/"

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


def viewer_page(file: str, row: RunRow, step: int, version: str, timeline: str) -> str:
    """The page that opens the run of ``file`` at a step, in the viewer of a version."""
    run = row.title or f"{row.name}, {row.estimator}, seed {row.seed}"
    layers = (file, file.removesuffix(".rrd") + ".review.rrd")
    values = {
        "title": f"{run}: step {step} - spherloc",
        "opening": f"Opening {run} at step {step} …",
        "program": f"{PROGRAM}{quote(version)}/",
        "files": " ".join(DATA + quote(name) for name in layers),
        "timeline": timeline,
        "step": str(step),
    }
    escaped = {name: html.escape(value) for name, value in values.items()}
    return Template(_text("viewer.html")).substitute(escaped, script=_text("viewer.js"))


@cache
def viewer_policy() -> str:
    """A policy under which the viewer works and reaches nothing but this server: no fonts, no statistics, no API.

    Only the page's own script runs, by its hash, and the program that it loads; so a recording cannot bring code.
    """
    digest = base64.b64encode(hashlib.sha256(_text("viewer.js").encode()).digest()).decode()
    rules = {
        "default-src": "'none'",
        "script-src": f"'sha256-{digest}' 'strict-dynamic' 'wasm-unsafe-eval'",
        "style-src": "'unsafe-inline'",
        "img-src": "data: blob:",
        "connect-src": "'self'",
        "base-uri": "'none'",
        "form-action": "'none'",
        "frame-ancestors": "'none'",
    }
    return "; ".join(f"{name} {value}" for name, value in rules.items())


@cache
def _text(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")
