"""What some tests need and a machine may lack.

A run says at its start what is lacking, and at its end what it skipped. A test may skip for these reasons only: one
that skips for another reason fails (see conftest.py), since the start did not tell of it.
"""

import ctypes
import functools
import importlib.util
import os
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import pytest

from spherloc.frontend import trained

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
"""Real data, which lie beside the project."""
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "microsoft-edge")
CHROMIUM = Path("/usr/lib/chromium")
"""Where Debian's Chromium has a Vulkan driver in software, which rerun's own viewer can use."""


@dataclass(frozen=True)
class Need:
    """Something that tests need: whether it is here, and what is said where it is not."""

    met: Callable[[], bool]
    lack: str


def _mounts() -> bool:
    """Whether a file system can be mounted, which takes an administrator."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            subprocess.run(["mount", "-t", "tmpfs", "tmpfs", folder], check=True, capture_output=True)
        except (OSError, subprocess.CalledProcessError):
            return False
        subprocess.run(["umount", "--lazy", folder], check=True, capture_output=True)
    return True


def vulkan() -> dict[str, str] | None:
    """Environment variables by which rerun's viewer finds a Vulkan driver; None if there is none."""
    if (CHROMIUM / "vk_swiftshader_icd.json").is_file() and (CHROMIUM / "libvulkan.so.1").is_file():
        paths = [str(CHROMIUM), *filter(None, os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep))]
        return {
            "LD_LIBRARY_PATH": os.pathsep.join(paths),
            "VK_ICD_FILENAMES": str(CHROMIUM / "vk_swiftshader_icd.json"),
        }
    try:
        ctypes.CDLL("libvulkan.so.1")
    except OSError:
        return None
    folders = (Path(folder) / "vulkan" / "icd.d" for folder in ("/usr/share", "/usr/local/share", "/etc"))
    return {} if any(any(folder.glob("*.json")) for folder in folders) else None


def _data(folder: str, what: str) -> Need:
    return Need((DATA / folder).is_dir, f"{what} (../shared/data/{folder}) are not on this machine")


NEEDS = {
    "aria_gen2": _data("aria_gen2", "the real problems with uncertain gravity"),
    "aria_adt_fisheye": _data("aria_adt_fisheye", "the real fisheye problems"),
    "formats_real": _data("formats_real", "the real calibrations"),
    "kapture_t265": _data("kapture_t265", "the real stereo fisheyes"),
    "stella_equirect_pair": _data("stella_equirect_pair", "the real panoramas"),
    "pano_vertical_pairs": _data("pano_vertical_pairs", "the real pairs of panoramas"),
    "opencv 5": Need(lambda: hasattr(cv2, "ALIKED_create"), "this OpenCV has no learned features (OpenCV 5 has)"),
    "weights": _data("weights", "trained weights of learned features"),
    "learned": Need(trained.installed, "the extra 'learned' is not installed (it takes 5 GB)"),
    "chromium": Need(
        lambda: bool(os.environ.get("SPHERLOC_CHROMIUM") or any(map(shutil.which, BROWSERS))),
        "no Chromium found: install Debian's chromium or set SPHERLOC_CHROMIUM to the path of one",
    ),
    "mkdocs": Need(
        lambda: all(map(importlib.util.find_spec, ("mkdocs", "material", "mkdocstrings_handlers"))),
        "the documentation cannot be built: its packages are not installed (make docs installs them)",
    ),
    "vulkan": Need(lambda: vulkan() is not None, "no Vulkan driver, which rerun's viewer needs without a screen"),
    "mount": Need(_mounts, "no file system can be mounted here"),
    "no superuser": Need(lambda: os.geteuid() != 0, "the superuser may read and delete everything"),
    "linux": Need(lambda: sys.platform == "linux", "this system is no Linux, where a missing display can be told"),
    "fork": Need(lambda: hasattr(os, "fork"), "this system does not fork processes"),
    "/proc": Need(Path("/proc/self/statm").exists, "this system has no /proc"),
    "/dev/full": Need(Path("/dev/full").exists, "this system has no /dev/full"),
    "file size limit": Need(lambda: hasattr(resource, "RLIMIT_FSIZE"), "this system limits no file sizes"),
}


@functools.cache
def lacking() -> dict[str, str]:
    """What is lacking here, by name: what is said of it."""
    return {name: need.lack for name, need in NEEDS.items() if not need.met()}


def require(*names: str) -> None:
    """Skip the test, or at the top of a file all of its tests, unless everything named is here."""
    for name in names:
        lack = NEEDS[name].lack
        if name in lacking():
            pytest.skip(lack, allow_module_level=True)


def needs(name: str) -> pytest.MarkDecorator:
    """``@needs("mount")``: the test is skipped where no file system can be mounted."""
    return pytest.mark.skipif(name in lacking(), reason=NEEDS[name].lack)


def real_data(folder: str) -> Path:
    """Path of a folder of real data; the test is skipped where it is absent."""
    require(folder)
    return DATA / folder
