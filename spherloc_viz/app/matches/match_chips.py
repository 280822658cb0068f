"""Small buttons in HTML: which reference image is shown, how a table is sorted."""

from html import escape

import numpy as np

from spherloc.problem import Problem
from spherloc.types import BoolArray
from spherloc_viz.app.text import box
from spherloc_viz.layers.match_view import reference_votes

MOST_REFERENCES = 8


def chip(words: str, touch: str, on: bool, hint: str = "") -> str:
    """A button; ``on`` marks the one that holds now."""
    look = "background:rgba(80,130,220,.28)" if on else "background:rgba(128,136,150,.16)"
    title = f' title="{escape(hint)}"' if hint else ""
    return (
        f'<span role="button" tabindex="0" data-touch="{escape(touch)}"{title} style="display:inline-block;'
        f'margin:0 .35em .35em 0;padding:.12em .6em;border-radius:1em;{look}">{escape(words)}</span>'
    )


def chips_html(problem: Problem, inlier_mask: BoolArray, shown: int | None) -> str:
    """Buttons for the references, those with most inliers first; empty if there is no choice."""
    inliers, matches = reference_votes(problem, inlier_mask)
    if shown is None or len(matches) < 2:
        return ""
    order = np.lexsort((-matches, -inliers))
    offered = [int(k) for k in order[:MOST_REFERENCES]]
    offered += [] if shown in offered else [shown]
    chips = "".join(
        chip(
            f"{k + 1}: {inliers[k]}/{matches[k]}",
            f"image-reference:{k}",
            k == shown,
            f"{problem.reference_images[k].name}: {inliers[k]} inliers of {matches[k]} matches",
        )
        for k in offered
    )
    left = f" {len(offered)} of {len(matches)} are offered." if len(offered) < len(matches) else ""
    note = f"References, inliers of matches.{left}"
    return box(f'<div style="opacity:.65;padding-bottom:.2em">{note}</div>{chips}', "font-size:12px")
