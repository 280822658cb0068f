"""What a user can do about a map, in the words of the command, or of the page, where there are no options."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar

COMMAND = {
    "calibration": "put {files} beside them, or give it with --camera FILE",
    "which camera": "to choose, name the images or their folder after their camera, or give --camera-name",
    "two circles": "have the camera's own program stitch them, or cut each in two, a folder for each lens; give "
    "--panorama if they are panoramas",
    "sphere": "they count as other photographs; --panorama takes them for panoramas",
    "resized": "give them as the camera has them, or --panorama if they were resized and show the whole sphere",
    "no panoramas": "have them stitched to the whole sphere, or make the map without --panorama",
    "moves along": "leave it out with --mask or --nadir",
    "carried": " (--nadir 0: not)",
    "more features": "; with ALIKED and LightGlue beside it: --features sift+aliked",
    "another size": "give it with --camera FILE, which scales it, if they were scaled",
    "other scale": "give --distance or --camera-height",
    "any scale": "--camera-height, --distance or --positions gives metres",
    "other folder": "give another --output",
    "go on": "make room there and give the same command, which goes on with what is done",
    "report again": "make room there and give the same command for the report",
    "sideways": "--gravity FILE says where down is",
    "another map": "give another folder with --output, or remove that one",
    "own folder": "give another folder with --output",
    "more images": "--frames says how many of each camera",
    "other positions": "--positions, --distance or --camera-height goes before it",
    "fewer images": "give fewer --frames",
    "all cameras": "give {folder}",
}
PAGE = {
    "calibration": "put {files} beside them, into that folder, and make the map again",
    "which camera": "to choose, name the images or their folder after their camera",
    "two circles": "have the camera's own program stitch them, or cut each in two, a folder for each lens",
    "sphere": "they count as other photographs",
    "resized": "give them as the camera has them",
    "no panoramas": "have them stitched to the whole sphere",
    "moves along": "take photographs without it, or make the map with the command spherloc map, which takes masks",
    "carried": "",
    "more features": "",
    "another size": "scale it to that of the photographs",
    "other scale": "give a height or a distance as Scale and make the map again",
    "any scale": "for metres, give a height or a distance as Scale and make the map again",
    "other folder": "make that folder writable, or open the photographs in another one",
    "go on": "make room there and make the map again, which goes on with what is done",
    "report again": "make room there and make the map again for the report",
    "sideways": "if so, make the map with the command spherloc map, which takes a file of gravity",
    "another map": "remove that folder, or rename that of the photographs",
    "own folder": "rename that of the photographs",
    "more images": "the command spherloc map takes more",
    "other positions": "a Scale that you give goes before it",
    "fewer images": "take fewer folders of cameras",
    "all cameras": "open the folder {folder}",
}
_words: ContextVar[Mapping[str, str]] = ContextVar("advice", default=COMMAND)


def advice(about: str) -> str:
    """A part of a sentence that says what to do: the words of the command, or of the page within ``for_a_page``."""
    return _words.get()[about]


@contextmanager
def for_a_page() -> Iterator[None]:
    """``advice`` gives the words of the page."""
    before = _words.set(PAGE)
    try:
        yield
    finally:
        _words.reset(before)
