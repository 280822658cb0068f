"""What the lists of presets and of scenes offer, and what they say of it (``choices.js`` shows it)."""

import json
from collections.abc import Sequence
from functools import cache
from html import escape
from pathlib import Path

from spherloc.datasets import bundled_scenes
from spherloc.datasets.scene_file import read_table
from spherloc_viz.app.catalog import Catalog
from spherloc_viz.app.controls.presets import Preset
from spherloc_viz.app.text import DIM, box

NO_PRESET = "choose …"


def preset_names(known: Sequence[Preset], hidden: bool) -> tuple[str, ...]:
    """What the list of presets offers, nothing first; ``hidden`` numbers them, since their titles tell what happens."""
    titles = (f"Preset {number}" if hidden else preset.title for number, preset in enumerate(known, 1))
    return (NO_PRESET, *titles)


def story_html(preset: Preset, changed: bool) -> str:
    """A preset's story and estimator, dimmed if the page was ``changed`` since. Both take the same room, that of the
    longer text."""
    story = f"{preset.story} Estimator: {preset.estimator}."
    after = f"Changed from the preset {preset.title}: {story}"
    texts = ((after, DIM),) if changed else ((after, "visibility:hidden"), (story, ""))
    words = "".join(f'<div style="grid-area:1/1;{look}">{escape(text)}</div>' for text, look in texts)
    return box(f'<div style="display:grid">{words}</div>', "font-size:12px")


def choices_html(presets: Sequence[Preset], catalog: Catalog, hidden: bool) -> str:
    """A sentence or two for each preset, and whether it fails, and for each bundled scene; none if answers are
    ``hidden``."""
    told = {preset.title: f"{'Fails' if preset.fails else 'Succeeds'}. {preset.story}" for preset in presets}
    about = _about()
    told |= {label: about.get(catalog.path(label), "") for label in catalog.scenes}
    words = {} if hidden else {name: text for name, text in told.items() if text}
    return f'<div hidden data-choices="{escape(json.dumps(words))}"></div>'


@cache
def _about() -> dict[Path, str]:
    """What each bundled scene is about, by its file."""
    return {path.resolve(): str(read_table(path).get("about", "")) for path in bundled_scenes().values()}
