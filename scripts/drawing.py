"""A little SVG: what the pictures of the documentation are made of."""

from collections.abc import Iterable
from html import escape

Point = tuple[float, float]

PAPER, INK, FAINT = "#141a22", "#dde3ea", "#8c97a8"
"""Pictures have a dark ground like the page's canvas, so that they look the same in light and dark surroundings."""


class Drawing:
    """A picture that grows; all lengths are pixels."""

    def __init__(self, width: float, height: float, title: str) -> None:
        """``title`` is what somebody who cannot see it is told."""
        self.width, self.height, self._title = width, height, title
        self._parts: list[str] = []

    def line(self, start: Point, end: Point, color: str = INK, width: float = 1.5, dash: str = "") -> None:
        """A straight line."""
        self.path((start, end), color, width, dash=dash)

    def path(
        self,
        points: Iterable[Point],
        color: str = INK,
        width: float = 1.5,
        fill: str = "none",
        opacity: float = 1.0,
        closed: bool = False,
        dash: str = "",
    ) -> None:
        """A line through points, filled if asked for."""
        d = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points) + ("Z" if closed else "")
        dashed = f' stroke-dasharray="{dash}"' if dash else ""
        self._parts.append(
            f'<path d="{d}" fill="{fill}" stroke="{color}" stroke-width="{width:g}" opacity="{opacity:g}"{dashed}/>'
        )

    def arrow(self, start: Point, end: Point, color: str = INK, width: float = 1.8) -> None:
        """A line with a head at its end."""
        (x0, y0), (x1, y1) = start, end
        length = max(((x1 - x0) ** 2 + (y1 - y0) ** 2) ** 0.5, 1e-9)
        ux, uy = (x1 - x0) / length, (y1 - y0) / length
        self.line(start, (x1 - 6 * ux, y1 - 6 * uy), color, width)
        back = (x1 - 9 * ux, y1 - 9 * uy)
        sides = [(back[0] - 4 * uy, back[1] + 4 * ux), end, (back[0] + 4 * uy, back[1] - 4 * ux)]
        self.path(sides, color, 0.5, fill=color, closed=True)

    def circle(
        self,
        centre: Point,
        radius: float,
        color: str = INK,
        fill: str = "none",
        opacity: float = 1.0,
        width: float = 1.2,
        dash: str = "",
    ) -> None:
        """A circle."""
        dashed = f' stroke-dasharray="{dash}"' if dash else ""
        self._parts.append(
            f'<circle cx="{centre[0]:.1f}" cy="{centre[1]:.1f}" r="{radius:.1f}" fill="{fill}" stroke="{color}" '
            f'stroke-width="{width:g}" opacity="{opacity:g}"{dashed}/>'
        )

    def dot(self, centre: Point, color: str, radius: float = 3.5, opacity: float = 1.0) -> None:
        """A filled dot."""
        self.circle(centre, radius, "none", fill=color, opacity=opacity)

    def box(
        self, x: float, y: float, width: float, height: float, fill: str, color: str = "none", opacity: float = 1.0
    ) -> None:
        """A box with round corners."""
        self._parts.append(
            f'<rect x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}" rx="4" fill="{fill}" '
            f'stroke="{color}" opacity="{opacity:g}"/>'
        )

    def text(
        self,
        x: float,
        y: float,
        words: str,
        size: float = 14,
        color: str = INK,
        anchor: str = "start",
        weight: str = "",
    ) -> None:
        """A line of words; ``anchor`` is start, middle or end."""
        bold = f' font-weight="{weight}"' if weight else ""
        self._parts.append(
            f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size:g}" fill="{color}" text-anchor="{anchor}"{bold}>'
            f"{escape(words)}</text>"
        )

    def svg(self) -> str:
        """The whole picture."""
        head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width:g} {self.height:g}" '
            f'width="{self.width:g}" height="{self.height:g}" role="img" '
            'font-family="system-ui, Segoe UI, Roboto, Helvetica, Arial, sans-serif">'
        )
        ground = f'<rect width="{self.width:g}" height="{self.height:g}" rx="8" fill="{PAPER}"/>'
        return "\n".join([head, f"<title>{escape(self._title)}</title>", ground, *self._parts, "</svg>\n"])
