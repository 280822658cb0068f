"""The Rerun viewer behind the front door: a page that opens one recording at one step, and all that it loads."""

from urllib.parse import urlencode


def viewer_link(file: str, step: int) -> str:
    """The path and query that open a recording of the folder of recordings at a step, unescaped for HTML."""
    return "/viewer/?" + urlencode({"run": file, "step": step})
