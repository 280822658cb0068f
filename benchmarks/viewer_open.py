"""From the click to the recording: how long a browser takes to show a run in the Rerun viewer, ours and the peer's way.

    python -m benchmarks.viewer_open [--openings 5]

Ours is the link of a running playground, which opens at the key step, paused. The peer is rerun's own way to show
a file in a browser, ``rerun --serve-web FILE``, which opens at the first step. Both show the same file in the same
Chromium, in turn, each in a profile of its own: the first opening has empty caches (and ours unpacks the viewer's
program then), the others do not. The time ends with the third frame after the viewer has recording and layout, and for
ours stands at the step; drawing in software is a large part of it where there is no graphics card. Prints the medians
and writes ``results/viewer_open.json``.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import BrowserContext, Playwright, sync_playwright

from benchmarks.browser_frames import FLAGS
from benchmarks.machine import describe
from benchmarks.playground import SCENE, playground
from spherloc.datasets import load_scene
from spherloc.estimators import estimate
from spherloc_viz.app.web.viewer import viewer_link
from spherloc_viz.recording.content.writer import write_recording
from spherloc_viz.recording.rerun_program import rerun_command, rerun_environment

RESULTS = Path(__file__).parent / "results" / "viewer_open.json"
OURS, PEER = "spherloc", "rerun --serve-web"
LIMIT_MS = 120_000
SHOWN = """() => {
    const viewer = window.spherlocViewer ?? window._handle;
    if (window.spherlocViewer && document.body.dataset.state !== "open") return false;
    // The layout has a view of the entity "/step", and the recording a timeline of that name.
    const state = viewer ? new TextDecoder().decode(viewer.viewer_state()) : "";
    window.frames_shown = /[^/]step/.test(state) && state.includes("/step") ? (window.frames_shown ?? 0) + 1 : 0;
    return window.frames_shown === 3 && performance.now();
}"""


def main() -> None:
    """Measure, print and store."""
    parser = argparse.ArgumentParser(description="Time the opening of a recording in the web viewer.")
    parser.add_argument("--openings", type=int, default=5, help="openings with full caches, after the one without")
    arguments = parser.parse_args()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        stack.enter_context(_own_cache(folder / "cache"))
        runs = folder / "runs"
        row = write_recording(estimate(load_scene(SCENE).problem(None), "mc"), runs / "run.rrd")
        address = stack.enter_context(playground(recordings=runs))[0].rstrip("/")
        links = {OURS: address + viewer_link("run.rrd", row.key_step + 1)}
        links[PEER] = stack.enter_context(_served_by_rerun(runs / "run.rrd"))
        player = stack.enter_context(sync_playwright())
        profiles = {name: stack.enter_context(_profile(player, folder / name)) for name in links}
        times: dict[str, list[float]] = {name: [] for name in links}
        for turn in range(1 + arguments.openings):
            for name in sorted(links, reverse=bool(turn % 2)):
                times[name].append(_open(profiles[name], links[name]))
        _report(times, row.size_bytes)


@contextmanager
def _own_cache(folder: Path) -> Iterator[None]:
    """Has the playground keep the viewer's program in a folder that is empty at first."""
    before = os.environ.get("SPHERLOC_CACHE")
    os.environ["SPHERLOC_CACHE"] = str(folder)
    try:
        yield
    finally:
        os.environ.pop("SPHERLOC_CACHE")
        if before is not None:
            os.environ["SPHERLOC_CACHE"] = before


@contextmanager
def _served_by_rerun(recording: Path) -> Iterator[str]:
    """The link that rerun's own program prints for a file."""
    words = ["--serve-web", "--bind", "127.0.0.1", "--port", "auto", "--web-viewer-port", "0", str(recording)]
    environment = rerun_environment() | {"RUST_LOG": "info", "NO_COLOR": "1"}
    with subprocess.Popen([*rerun_command(), *words], stderr=subprocess.PIPE, text=True, env=environment) as server:
        assert server.stderr is not None
        try:
            found = (re.search(r"connect at (http://127\.0\.0\.1:\S+)", line) for line in server.stderr)
            yield next(match[1] for match in found if match)
        finally:
            server.terminate()


@contextmanager
def _profile(player: Playwright, folder: Path) -> Iterator[BrowserContext]:
    path = os.environ.get("SPHERLOC_CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    if path is None:
        raise SystemExit("no Chromium found; install one or set SPHERLOC_CHROMIUM to its path.")
    flags = [*FLAGS, "--disable-background-networking"]
    size = {"width": 1280, "height": 720}
    context = player.chromium.launch_persistent_context(
        folder,
        executable_path=path,
        args=flags,
        viewport=size,  # pyright: ignore[reportArgumentType]
    )
    try:
        yield context
    finally:
        context.close()


def _open(profile: BrowserContext, link: str) -> float:
    """Milliseconds from the navigation to the picture."""
    page = profile.new_page()
    try:
        page.goto(link, wait_until="commit", timeout=LIMIT_MS)
        shown = page.wait_for_function(SHOWN, timeout=LIMIT_MS, polling="raf").json_value()
        # The browser keeps the compiled program for the next time once the page has rested for a while.
        page.wait_for_timeout(4000)
        return float(shown)
    finally:
        page.close()


def _report(times: dict[str, list[float]], size_bytes: int) -> None:
    results: dict[str, Any] = {"machine": describe(), "recording_bytes": size_bytes, "milliseconds": times}
    print(f"a recording of {size_bytes / 1e6:.2f} MB, first opening and median of {len(times[OURS]) - 1} more")
    for name, (cold, *warm) in times.items():
        results[name] = {"cold_ms": cold, "warm_ms": float(np.median(warm))}
        print(f"  {name:18} {cold:7.0f} ms, {np.median(warm):7.0f} ms")
    for kind in ("cold_ms", "warm_ms"):
        results[f"ratio_{kind.removesuffix('_ms')}"] = results[PEER][kind] / results[OURS][kind]
    print(f"{PEER} takes {results['ratio_cold']:.2f} and {results['ratio_warm']:.2f} times as long")
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
