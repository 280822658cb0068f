"""Pictures of every view, dark and light, at 1280 x 720 or 1920 x 1080, most at both: ``make screenshots``.

They go to build/screenshots. Those that the documentation shows are written to docs/ as well.
"""

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from playwright.sync_api import Page, expect, sync_playwright

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "build" / "screenshots"
Size = tuple[int, int]
SIZES: tuple[Size, ...] = ((1280, 720), (1920, 1080))
FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
THEMES = ("dark", "light")
SYNTHETIC, STREET = "scenes/panorama_outliers_80.toml", "scenes/street_fisheye.toml"
APARTMENT, CAMPUS = "scenes/apartment_night_panorama.toml", "scenes/campus_panorama.toml"
PATIENCE_MS = 240_000
JPEG = (cv2.IMWRITE_JPEG_QUALITY, 80, cv2.IMWRITE_JPEG_OPTIMIZE, 1)
"""With less quality small words get fringes."""
STILL_S = 8.0
"""How long the page may go on changing before it is photographed all the same."""
ROUNDING = 3
"""Largest difference of a colour, of 255, between two photographs of a page that stands still."""
TO_TOP = "() => document.querySelectorAll('*').forEach(box => { if (box.scrollTop > 0) box.scrollTop = 0; })"
"""A panel that was scrolled to press something shows its beginning again."""
SCROLLED = ("gallery",)
"""Views that the page itself scrolls to what matters."""
CASES = (
    "too-few-inliers",
    "larger-false-consensus",
    "pairs-outvote",
    "moving-object",
    "ransac-bad-luck",
    "gravity-off",
)
"""Of the gallery: what there is to be reviewed."""
NIGHT = (
    *("sweep", *(str(ROOT / "scenes" / f"{name}.toml") for name in ("panorama_outliers_80", "fisheye_outliers_90"))),
    *("--estimator", "mc", "--estimator", "ransac-2p", "--estimator", "ransac-p3p"),
    *("--values", "0.5", "0.8", "0.9", "0.95", "--runs", "12"),
)
"""What makes the runs on the triage desk."""
DOCS = {
    "desk": "desk_dark_1920x1080",
    "recordings": "recordings_dark_1280x720",
    "playground": "arcs_dark_1280x720",
    "selection": "selection_dark_1280x720",
    "sweep": "sweep_dark_1280x720",
    "street": "images_dark_1280x720",
}
"""Names in docs/ of pictures."""
View = Callable[[Page], object]
"""Brings the page to what is to be seen."""
Views = dict[str, View]


def tab(page: Page, name: str) -> None:
    """Open a tab."""
    page.get_by_role("tab", name=name, exact=True).click()


def press(page: Page, name: str) -> None:
    """Press a button."""
    page.get_by_role("button", name=name, exact=True).click()


def choose(page: Page, label: str, option: str) -> None:
    """Choose the first option that holds these words."""
    name = page.locator("label", has_text=re.compile(f"^{label}$"))
    widget = page.locator(f"[id='{name.get_attribute('for')}']")
    widget.click()
    page.get_by_role("option").filter(has_text=option).first.click()
    expect(widget).to_have_value(re.compile(re.escape(option)))


def step(page: Page, title: str) -> None:
    """Go to the first step whose title holds these words."""
    choose(page, "Step", title)


def estimator(page: Page, name: str) -> None:
    """Choose an estimator."""
    choose(page, "Estimator", name)
    said = page.locator("//tr[td[1][normalize-space()='estimator']]/td[2]")
    expect(said).to_have_text(name)


def select_a_match(page: Page) -> None:
    """Select a match in the table."""
    step(page, "The yaw most arcs share")
    tab(page, "Matches")
    page.locator("tr[data-touch^='select:']").nth(3).click()
    page.locator("[data-touch='deselect:']").wait_for()


def compare(page: Page) -> None:
    """Compare the estimators that are ticked."""
    tab(page, "Compare")
    press(page, "Compare")
    page.locator("tr[data-touch='use:ransac-2p']").first.wait_for()
    page.get_by_role("button", name="Compare", exact=True).wait_for()


def sweep(page: Page) -> None:
    """A small sweep."""
    tab(page, "Sweep")
    label = page.locator("label", has_text=re.compile("^Runs$"))
    entry = label.locator("xpath=ancestor::*[contains(@class, 'Flex-root')][1]").locator("input")
    entry.fill("1")
    entry.press("Enter")
    press(page, "Start sweep")
    page.get_by_role("button", name="CSV", exact=True).wait_for()
    page.get_by_role("button", name="Start sweep", exact=True).wait_for()


def review(page: Page) -> None:
    """Look for a failure in the list of runs, which may have many by now, and open it."""
    tab(page, "Residuals")
    tab(page, "Recordings")
    label = page.locator("label", has_text=re.compile("^Search$"))
    label.locator("xpath=ancestor::*[contains(@class, 'Flex-root')][1]").locator("input").fill("false consensus")
    page.locator("[data-touch^='run-open:gallery/larger-false-consensus']").first.click()
    page.locator("[data-touch='run-close:'] >> visible=true").first.wait_for()


def sequence(page: Page) -> None:
    """Localize all queries of the scene, and look at the route from above."""
    press(page, "Localize all queries")
    page.get_by_role("button", name="Stop", exact=True).wait_for()
    page.get_by_role("button", name="Localize all queries", exact=True).wait_for()
    press(page, "Above")


def gallery(page: Page) -> None:
    """Open a case of the gallery."""
    tab(page, "Recordings")
    page.get_by_text("Gallery", exact=True).first.click()
    page.locator("[data-touch='gallery-open:moving-object']").first.click()
    page.locator("[data-touch^='gallery-beside:moving-object']").first.wait_for()


SYNTHETIC_VIEWS: Views = {
    "opening": lambda page: tab(page, "Yaw"),
    "arcs": lambda page: step(page, "The yaw most arcs share"),
    "roots": lambda page: step(page, "roots"),
    "charts": lambda page: (step(page, "The yaw most arcs share"), tab(page, "Charts")),
    "balls": lambda page: (tab(page, "Yaw"), step(page, "The maximum clique of balls")),
    "residuals": lambda page: (step(page, "Outcome"), tab(page, "Residuals")),
    "pixels": lambda page: tab(page, "Images"),
    "selection": select_a_match,
    "exact": lambda page: (estimator(page, "mc-exact"), tab(page, "Yaw"), step(page, "What no pose can beat")),
    "ransac": lambda page: (estimator(page, "ransac-2p"), tab(page, "Residuals")),
    "compare": compare,
    "sweep": sweep,
    "open": lambda page: tab(page, "Open"),
    "share": lambda page: tab(page, "Share"),
    "recordings": review,
    "gallery": gallery,
}
STREET_VIEWS: Views = {
    "map": lambda page: tab(page, "Yaw"),
    "images": lambda page: tab(page, "Images"),
    "from_the_camera": lambda page: press(page, "From the camera"),
    "sequence": sequence,
}
SCENES: tuple[tuple[str, Views, tuple[Size, ...]], ...] = (
    (SYNTHETIC, SYNTHETIC_VIEWS, SIZES),
    (STREET, STREET_VIEWS, SIZES),
    (APARTMENT, {"apartment": lambda page: tab(page, "Images")}, SIZES[:1]),
    (CAMPUS, {"campus": lambda page: tab(page, "Images")}, SIZES[1:]),
)


PROGRAM = str(Path(sys.executable).with_name("spherloc"))


@contextmanager
def served(scene: str, recordings: Path) -> Iterator[str]:
    """Address of a playground."""
    words = [PROGRAM, "play", scene, "--port", "0", "--recordings", str(recordings)]
    server = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        assert server.stdout is not None
        yield server.stdout.readline().split()[-1]
    finally:
        server.send_signal(signal.SIGINT)
        server.wait(30)


def take(page: Page, address: str, dark: bool) -> None:
    """Open the playground and wait for its first picture."""
    page.goto(address)
    page.locator("//tr[td[1][normalize-space()='outcome']]/td[2]").first.wait_for(timeout=PATIENCE_MS)
    seen = "() => window.__viserSceneTree?.getState()['/map/points']?.effectiveVisibility"
    page.wait_for_function(seen)
    still(page)
    # viser says that it draws in software, which a person's browser does not.
    for close in page.locator("[class*=Notification-closeButton]").all():
        close.click()
    if not dark:
        page.get_by_text("Dark", exact=True).click()


def take_desk(page: Page, address: str, dark: bool) -> None:
    """Open the triage desk, which follows the theme of the system."""
    page.emulate_media(color_scheme="dark" if dark else "light")
    page.goto(f"{address.rstrip('/')}/desk")
    page.locator("body[data-state=open]").wait_for()


def desk(page: Page) -> None:
    """The failures, and one of them with its evidence."""
    page.locator("#chips [data-filter=outcome] button", has_text="failure").click()
    page.wait_for_timeout(500)
    page.keyboard.press("ArrowDown")
    page.keyboard.press("ArrowDown")


def still(page: Page) -> bytes:
    """The picture of the page once two photographs in a row are the same."""
    last, end = b"", time.monotonic() + STILL_S
    while time.monotonic() < end:
        page.wait_for_timeout(400)
        before, last = last, page.screenshot(timeout=PATIENCE_MS)
        if before and _alike(before, last):
            break
    return last


def _alike(one: bytes, other: bytes) -> bool:
    """Whether two pictures (PNG) differ by rounding alone, which alternates from frame to frame."""
    if one == other:
        return True
    pixels = (cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR) for png in (one, other))
    return int(cv2.absdiff(*pixels).max()) <= ROUNDING


def main() -> None:
    """Take all pictures, or those that are given: "arcs", "arcs_dark" or "arcs_dark_1280x720"."""
    if sys.argv[1:]:
        take_all()
        return
    names = (*(name for _, views, _ in SCENES for name in views), "desk")
    halves = [[f"{name}_{theme}" for name in names] for theme in THEMES]
    running = [subprocess.Popen([sys.executable, __file__, *words], cwd=ROOT) for words in halves]
    sys.exit(max(one.wait() for one in running))


def take_all() -> None:
    """Take the pictures that are given."""
    path = os.environ.get("SPHERLOC_CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    if path is None:
        raise SystemExit("no Chromium found; install one or set SPHERLOC_CHROMIUM to its path.")
    FOLDER.mkdir(parents=True, exist_ok=True)
    expect.set_options(timeout=PATIENCE_MS)
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as folder:
        cases, runs = Path(folder) / "cases", Path(folder) / "runs"
        for scene, views, sizes, recordings, made_by, opened in (
            *(
                (scene, views, sizes, cases, ("gallery", *CASES, "--output", str(cases / "gallery")), take)
                for scene, views, sizes in SCENES
            ),
            (SYNTHETIC, {"desk": desk}, SIZES, runs, (*NIGHT, "--recordings", str(runs)), take_desk),
        ):
            rounds = [(size, theme, _chosen(views, size, theme)) for size in sizes for theme in THEMES]
            if not any(chosen for _, _, chosen in rounds):
                continue
            if not recordings.exists():
                subprocess.run([PROGRAM, *made_by], cwd=folder, check=True, stdout=subprocess.DEVNULL)
            with served(scene, recordings) as address:
                for size, theme, chosen in rounds:
                    if chosen:
                        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
                        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
                        page.add_init_script("localStorage.setItem('spherloc-introduction', 'seen')")
                        page.set_default_timeout(PATIENCE_MS)
                        opened(page, address, theme == "dark")
                        for name, view in chosen.items():
                            picture(page, name, view, theme, size)
                        browser.close()


def _chosen(views: Views, size: Size, theme: str) -> Views:
    """Those of the views that are to be taken in that size and theme."""
    wanted = sys.argv[1:]
    stems = {name: stem(name, theme, size) for name in views}
    return {
        name: view for name, view in views.items() if any(f"{stems[name]}_".startswith(f"{word}_") for word in wanted)
    }


def stem(name: str, theme: str, size: Size) -> str:
    """What a picture is called."""
    return f"{name}_{theme}_{size[0]}x{size[1]}"


def picture(page: Page, name: str, view: View, theme: str, size: Size) -> None:
    """Bring the page to a view and photograph it."""
    start = time.monotonic()
    view(page)
    path = FOLDER / f"{stem(name, theme, size)}.png"
    page.mouse.move(size[0] // 2, 2)  # away from what was pressed, and what it tells of itself
    if name not in SCROLLED:
        page.evaluate(TO_TOP)
    path.write_bytes(still(page))
    for deselect in page.locator("[data-touch='deselect:']").all():
        deselect.click()
    for title, shown in DOCS.items():
        if shown == path.stem:
            image = cv2.imread(str(path))
            assert image is not None
            cv2.imwrite(str(ROOT / "docs" / f"{title}.jpg"), image, JPEG)
    print(f"{path.relative_to(ROOT)}, {time.monotonic() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
