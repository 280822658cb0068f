"""The scenes that can be opened, as HTML whose rows are pressed."""

from collections.abc import Sequence
from html import escape
from pathlib import Path

from spherloc_viz.app.panels.folders import Listing, Row
from spherloc_viz.app.text import DIM, box, status_html

RULE = "border-top:1px solid rgba(128,140,160,.22)"


def list_html(
    listing: Listing | None, roots: Sequence[Path], recent: Sequence[Row], bundled: Sequence[Row], remark: str
) -> str:
    """A folder's content, or the folders that may be looked into; then recent and bundled scenes."""
    if listing is None:
        folders = [_row_html(f"open-folder:0:{k}:", f"{root.name}/", str(root)) for k, root in enumerate(roots)]
        parts = [_section("Folders", folders)]
    else:
        parts = [_folder_html(listing)]
    parts += [_section(title, [_scene_html(row) for row in rows]) for title, rows in _titled(recent, bundled)]
    return box("".join(parts), "font-size:12.5px") + (status_html(remark) if remark else "")


def _titled(recent: Sequence[Row], bundled: Sequence[Row]) -> list[tuple[str, Sequence[Row]]]:
    return [(title, rows) for title, rows in (("Recent", recent), ("Bundled", bundled)) if rows]


def _folder_html(listing: Listing) -> str:
    """Folder by folder; first the way up, last the other pages."""
    above = "open-folder:" if listing.parent is None else f"open-folder:0:{listing.parent}"
    rows = [_row_html(above, "↑ up" if listing.parent else "↑ all folders", "")]
    for row in listing.rows:
        if row.kind == "folder":
            rows.append(_row_html(f"open-folder:0:{row.place}", f"{row.name}/", ""))
        else:
            rows.append(_scene_html(row))
    if not listing.rows:
        rows.append(_row_html(None, "no folders and no scene files (*.toml)", ""))
    pages = ""
    if listing.pages > 1:
        ways = (("‹ before", listing.page - 1), ("after ›", listing.page + 1))
        links = [
            _link(f"open-folder:{page}:{listing.place}", words) for words, page in ways if 0 <= page < listing.pages
        ]
        pages = f'<div style="padding:.3em 0">page {listing.page + 1} of {listing.pages} {" ".join(links)}</div>'
    remarks = "".join(f'<div style="font-size:11.5px;{DIM}">{escape(words)}</div>' for words in listing.remarks)
    return _section(f"{listing.folder.name}/", rows) + pages + remarks


def _link(action: str, words: str) -> str:
    look = "text-decoration:underline;margin-left:.6em"
    return f'<span role="button" tabindex="0" data-touch="{escape(action)}" style="{look}">{escape(words)}</span>'


def _section(title: str, rows: Sequence[str]) -> str:
    head = f'<div style="font-weight:600;padding:.5em 0 .2em;overflow-wrap:anywhere">{escape(title)}</div>'
    return f'{head}<table style="border-collapse:collapse;width:100%">{"".join(rows)}</table>'


def _scene_html(row: Row) -> str:
    return _row_html(f"open-scene:{row.place}" if row.kind == "scene" else None, row.name, row.about)


def _row_html(action: str | None, name: str, about: str) -> str:
    """A row that is pressed; paler if there is nothing to press."""
    touch = "" if action is None else f' role="button" tabindex="0" data-touch="{escape(action)}"'
    words = f'<div style="font-size:11.5px;{DIM};overflow-wrap:anywhere">{escape(about)}</div>' if about else ""
    pale = f"{DIM};" if action is None else ""
    cell = f'<td style="{RULE};{pale}padding:.25em .4em;overflow-wrap:anywhere">{escape(name)}{words}</td>'
    return f"<tr{touch}>{cell}</tr>"
