"""The terms that the page underlines, each explained in a sentence or two when it is pressed."""

import json
import re
from functools import lru_cache
from html import escape

from spherloc_viz.app.text import DIM, box

TERMS: dict[str, str] = {
    "match": "A pixel of the query image and the map point that it is said to show. Many are wrong.",
    "bearing": "The direction in which a pixel looks: a dot on the unit sphere, whatever the lens.",
    "gravity": "Which way is down, in the camera and in the map. It settles roll and pitch, so that only the yaw and "
    "the position are open: 4 numbers instead of 6.",
    "yaw": "The angle by which the camera is turned about the vertical.",
    "yaw ring": "The circle around the unit sphere: a place on it is the direction in which the camera looks with some "
    "yaw. Its outline is as high as arcs overlap there.",
    "arc": "The yaws at which two matches can both be right, up to their noise: a piece of the yaw ring. A pair "
    "has up to two, of which at most one holds the true yaw.",
    "root": "A yaw at which the line between a pair's points lies in the plane of its bearings. A pair has two or "
    "none, so it has up to two arcs.",
    "ball": "All camera positions that two matches allow, once the yaw is known: around the point where their rays "
    "come nearest to each other, as far as noise can move it.",
    "effort": "How much work the exact search does before it ends, or stops with a gap: counted, so that the same "
    "problem always ends at the same place.",
    "edge": "Two nodes of a graph that agree: two balls that overlap, or two matches that can both be right.",
    "graph": "Nodes and the edges between those that agree. For the position, nodes are balls.",
    "clique": "Nodes that all agree with each other: balls of which any two overlap.",
    "maximum clique": "The largest clique there is. Balls of right pairs all hold the true position, so that they form "
    "one; those of wrong pairs lie anywhere.",
    "bound": "How far a match may be off, in pixels, to count as an inlier.",
    "inlier": "A match within the bound of the pose at hand.",
    "outlier": "A match beyond the bound of the pose at hand.",
    "consensus": "All matches within the bound of a pose. Maximum consensus looks for the pose that has most.",
    "precision": "Share of the inliers that are right.",
    "recall": "Share of the right matches that are inliers.",
    "F1": "One number for precision and recall, their harmonic mean: 100 % where both are.",
    "residual": "How far the map point is seen from the pixel of its match, with the pose at hand.",
    "refinement": "Gauss-Newton steps that move the pose until the residuals of its inliers are least.",
    "RANSAC": "Draws the smallest sample that fixes a pose, counts the matches that agree, and keeps the best.",
    "sample": "The matches that RANSAC draws to fix one pose.",
    "certificate": "A bound that no pose can beat; where the pose at hand reaches it, it is proven to be the best.",
    "NFA": "Number of false alarms: how many sets of so many wrong matches are expected to agree with some pose by "
    "chance. Far below 1, the matches do not agree by chance; near 1 or above, nobody can know the pose.",
    "covariance": "How sure the pose is by its inliers: drawn as an ellipsoid of three standard deviations.",
    "expected error": "How far the pose may be off (RMS) by the noise of its inliers. An error of the map, of the lens "
    "or of the matches' choice adds to it, and is not in it.",
    "degenerate geometry": "The inliers leave the pose open, in part or altogether: they lie in one direction, or far "
    "away, or too few are left.",
    "alternative pose": "Another pose that is worth a look: one that explains about as many matches, or the right one "
    "where the truth is known.",
    "estimator": "A method that computes the pose from all matches, most of them wrong. mc-exact can prove its answer, "
    "mc is the paper's, ransac-2p draws pairs; the others are baselines that draw larger samples.",
    "diagnosis": "The cause that explains best why a run failed or cannot be trusted, with its evidence and advice.",
    "doubtful": "What a run is judged without the truth that has a pose and a reason not to trust it.",
    "suspect": "Of recorded runs: the diagnosis names a cause. Such a run may still have been localized.",
    "front end": "What makes matches of images: it finds features, matches them with those of the references, and "
    "looks up their map points.",
    "query": "The image whose camera is to be localized.",
    "reference": "An image of the map with a known pose; the query is matched with it.",
    "seed": "The number from which all random draws follow: the same seed gives the same run again.",
    "step": "A moment of a run with a picture and words of its own. Previous, Next and the timeline walk through them.",
    "scene": "What there is to localize: a simulation, drawn or real images, or a file of matches.",
    "sweep": "Many runs while one property of the scene grows, to see from where on an estimator fails.",
    "recording": "A file of one run with all its numbers: it opens again here, in Rerun's viewer, and in Python.",
}
"""By the word that stands on the page."""
_PLURALS = {"match": "matches", "query": "queries", "diagnosis": "diagnoses"}
_FORMS = {form: term for term in TERMS for form in (term, _PLURALS.get(term, f"{term}s"))}
_WORDS = re.compile(rf"\b({'|'.join(sorted(map(re.escape, _FORMS), key=len, reverse=True))})\b")


@lru_cache(maxsize=256)
def linked(words: str) -> str:
    """Words as HTML, in which every term is marked where it first stands: pressing it tells what it means."""
    seen: set[str] = set()

    def mark(found: re.Match[str]) -> str:
        term = _FORMS[found[0]]
        if term in seen:
            return found[0]
        seen.add(term)
        return _mark(term, found[0], "term")

    # Escaped text has no such words in what stands for a character.
    return _WORDS.sub(mark, escape(words))


def help_html(term: str) -> str:
    """A question mark that tells what a term means."""
    return _mark(term, "?", "help")


def heading_html(words: str, term: str) -> str:
    """What a panel shows, in a line, with a question mark that tells what a term means."""
    return box(f'<span style="{DIM}">{escape(words)}</span>{help_html(term)}', "font-size:12px")


def _mark(term: str, words: str, look: str) -> str:
    tip = escape(f"{term}: {TERMS[term]}")
    name = f' aria-label="What is {escape(term)}?"' if words == "?" else ""
    return (
        f'<span class="{look}" role="button" tabindex="0" data-define="{escape(term)}" title="{tip}"{name}>'
        f"{words}</span>"
    )


def glossary_html() -> str:
    """All terms, for the window that a press on one opens (``glossary.js``)."""
    return f'<div hidden data-glossary="{escape(json.dumps(TERMS))}"></div>'
