"""Finished pictures: where their parts are, and their bytes."""

import io

from matplotlib.figure import Figure


def fix_layout(figure: Figure) -> None:
    """Place the parts of a picture for good. To save it would place them twice, and draw all for each time."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine("none")
    for axes in figure.axes:
        axes.apply_aspect()


def png_of(figure: Figure) -> bytes:
    """PNG of a picture; the same picture gives the same bytes."""
    fix_layout(figure)
    file = io.BytesIO()
    figure.savefig(file, format="png", metadata={"Software": None})
    return file.getvalue()


def svg_of(figure: Figure) -> str:
    """SVG of a picture; the same picture gives the same text."""
    fix_layout(figure)
    file = io.StringIO()
    figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    return file.getvalue()
