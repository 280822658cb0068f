"""The desk's page: one file with its style and its scripts, and the policy under which it runs."""

import base64
import hashlib
import json
from functools import cache
from html import escape
from pathlib import Path
from string import Template

from spherloc.diagnosis import Measures
from spherloc_viz import style
from spherloc_viz.app.review.words import COLORS
from spherloc_viz.recording.reviews import MAX_LABELS

SCRIPTS = ("runs.js", "charts.js", "saved.js", "desk.js")
"""The page's scripts: those that hold the runs, draw them, store and send, and the one that connects them."""
COLUMNS = {
    "outcome": ("outcome", "success, failure, or unknown where there is no truth"),
    "diagnosis": ("cause", "What the diagnosis says"),
    "scene": ("scene", "Its scene file"),
    "name": ("problem", "Name of the problem"),
    "query": ("query", "Name of the query image"),
    "changes": ("changes", "What was changed of the scene"),
    "estimator": ("estimator", "Registered name"),
    "source": ("source", "Who ran it"),
    "title": ("title", "Of a curated case"),
    "units": ("units", "m, or units where the map's scale is unknown"),
    "doubtful": ("suspect", "Whether the diagnosis names a cause, by the truth where that is known"),
    "proven": ("proven", "Whether the certificate has no gap"),
    "labels": ("labels", "Words of a reviewer"),
    "created": ("time of day", "When it was recorded"),
    "seed": ("seed", "Of the estimator"),
    "correspondences": ("N", "Matches"),
    "inliers": ("inliers", "Correspondences within the noise bound of the pose"),
    "outlier_rate": ("outlier rate", "Share of wrong matches, 0 to 1"),
    "rotation_error_deg": ("rotation error, °", "Against the true pose"),
    "translation_error_m": ("position error, {unit}", "Against the true pose, in the map's unit"),
    "time_ms": ("time, ms", "Wall time of the estimator"),
    "steps": ("steps", "On the timeline"),
    "key_step": ("key step", "Where the run was decided, or went wrong"),
    "size_bytes": ("size, bytes", "Of the recording"),
    "residual_median": ("residual, median", "Of the inliers, in noise bounds"),
    "residual_p90": ("residual, 90 %", "Of the inliers, in noise bounds"),
    "alternative_support": ("alternative pose", "Inliers of the best other pose, as a share of the best pose's"),
    "certificate_gap": ("certificate gap", "Upper less lower bound, as a share of the upper one; 0 is proven"),
    "tilt_deg": ("tilt, °", "Between the given gravity and the matches'"),
    "coverage": ("coverage", "Share of the directions with matches that have inliers"),
    "rotation_sd_deg": ("rotation sd, °", "Standard deviation in the worst direction"),
    "position_sd_m": ("position sd, {unit}", "Standard deviation in the worst direction, in the map's unit"),
}
"""Heading and explanation of each column."""


@cache
def desk_page() -> tuple[str, str]:
    """The page and its content security policy."""
    script = "\n".join(_text(name) for name in SCRIPTS)
    settings = {
        "columns": COLUMNS,
        "colors": {outcome: style.css(color) for outcome, color in COLORS.items()},
        "accent": style.css(style.ESTIMATE),
        "mostLabels": MAX_LABELS,
        "measures": list(Measures.__dataclass_fields__),
    }
    page = Template(_text("desk.html")).substitute(
        css=_text("desk.css"), script=script, settings=escape(json.dumps(settings))
    )
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    rules = {
        "default-src": "'none'",
        "script-src": f"'sha256-{digest}'",
        "style-src": "'unsafe-inline'",
        "img-src": "'self' data:",
        "connect-src": "'self'",
        "base-uri": "'none'",
        "form-action": "'none'",
        "frame-ancestors": "'none'",
    }
    return page, "; ".join(f"{name} {value}" for name, value in rules.items())


def _text(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")
