"""Damaged COLMAP models: one sentence with file and place, or a model of finite numbers; never anything else."""

import re
import struct
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from colmap_samples import binary_files, sample_model, text_files, with_rigs, write
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from spherloc.errors import InputError
from spherloc.formats.colmap_files import read_model

NASTY = (
    b"\xff" * 8,
    b"\0" * 8,
    struct.pack("<d", np.nan),
    struct.pack("<d", np.inf),
    struct.pack("<Q", 2**40),
    struct.pack(">Q", 3),
    *(b"nan", b"-1", b"1e999", b", ", b"\n", b"\n\n", b"#", b" ", b"1_0", b"0x1", b"\xff\xfe", b"\r"),
    "\u0661".encode(),  # a digit to Python
)


@cache
def intact(layout, text):
    sample = sample_model(np.random.default_rng(3), images=3, points=5)
    if layout == "rigs":
        sample = with_rigs(sample, np.random.default_rng(4), frames=2)
    return (text_files if text else binary_files)(sample)


@st.composite
def damaged(draw):
    """Files of a model, one of them cut, flipped, overwritten, or with a piece added or taken out."""
    text = draw(st.booleans())
    files = dict(intact(draw(st.sampled_from(["old", "rigs"])), text))
    name = draw(st.sampled_from(sorted(files)))
    content = bytearray(files[name])
    at = draw(st.integers(0, len(content) - 1))
    kind = draw(st.sampled_from(["cut", "flip", "overwrite", "insert", "remove", "repeat"]))
    piece = draw(st.one_of(st.sampled_from(NASTY), st.binary(min_size=1, max_size=12)))
    length = draw(st.integers(1, 80))
    if kind == "cut":
        del content[at:]
    elif kind == "flip":
        content[at] ^= 1 << draw(st.integers(0, 7))
    elif kind == "overwrite":
        content[at : at + len(piece)] = piece
    elif kind == "insert":
        content[at:at] = piece
    elif kind == "remove":
        del content[at : at + length]
    else:
        content[at:at] = content[at : at + length]
    return text, files | {name: bytes(content)}


def check_sentence(error, folder):
    message = str(error)
    assert str(folder) in message and message.isprintable() and message.endswith(".") and len(message) < 600


@given(case=damaged())
@settings(max_examples=120, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_models_are_read_whole_or_refused_with_the_place(case, tmp_path):
    _, files = case
    folder = write(tmp_path, files)
    try:
        model = read_model(folder)
    except InputError as error:
        check_sentence(error, folder)
        assert re.search(r"\.(bin, up to byte \d+|txt, line \d+|bin|txt): ", str(error))
    else:
        assert np.isfinite(model.points.xyz).all()
        for image in model.images.values():
            rotation = image.cam_from_map[:, :3]
            np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
            assert np.isfinite(image.cam_from_map).all() and np.isfinite(image.pixels).all()
    finally:
        for path in folder.iterdir():
            path.unlink()


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
def test_every_cut_of_a_binary_file_is_noticed(name, tmp_path):
    """COLMAP's reader alone takes a cut file for a shorter one."""
    files = intact("rigs", False)
    folder = write(tmp_path, files)
    for length in range(0, len(files[name]), max(1, len(files[name]) // 60)):
        (folder / name).write_bytes(files[name][:length])
        with pytest.raises(InputError, match=rf"{name}, up to byte \d+: "):
            read_model(folder)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
@pytest.mark.parametrize("count", [2**63, 2**40, 2**32, struct.unpack("<Q", struct.pack(">Q", 3))[0]])
def test_huge_counts_and_wrong_endianness(name, count, tmp_path):
    files = intact("rigs", False)
    folder = write(tmp_path, files | {name: struct.pack("<Q", count) + files[name][8:]})
    with pytest.raises(InputError, match=rf"{name}, up to byte 8: {count} .* more than the file can hold"):
        read_model(folder)


def changed(sample, what):
    """The sample with one thing wrong, and what is said of it."""
    camera, image, point = sample.cameras[0], sample.images[0], sample.points[0]
    far = np.column_stack([image[1][:, :3], [np.inf, 0, 0]])
    others, more, rest = sample.cameras[1:], sample.images[1:], sample.points[1:]
    return {
        "unknown model": lambda: replace(sample, cameras=[(camera[0], 99, *camera[2:]), *others]),
        "NaN parameter": lambda: replace(sample, cameras=[(*camera[:4], (np.nan, 320.0)), *others]),
        "camera twice": lambda: replace(sample, cameras=[*sample.cameras, camera]),
        "no such camera": lambda: replace(sample, images=[(*image[:2], 55, *image[3:]), *more]),
        "image twice": lambda: replace(sample, images=[*sample.images, image]),
        "no name": lambda: replace(sample, images=[(*image[:3], "", image[4]), *more]),
        "NaN pixel": lambda: replace(sample, images=[(*image[:4], [(np.nan, 1.0, 100)]), *more]),
        "infinite translation": lambda: replace(sample, images=[(image[0], far, *image[2:]), *more]),
        "NaN point": lambda: replace(sample, points=[(100, np.array([0, np.nan, 0]), *point[2:]), *rest]),
        "far point": lambda: replace(sample, points=[(100, np.array([0, -1e200, 0]), *point[2:]), *rest]),
        "track of no image": lambda: replace(sample, points=[(*point[:3], [(999, 0)]), *rest]),
        "point twice": lambda: replace(sample, points=[*sample.points, point]),
        "track of no keypoint": lambda: replace(sample, points=[(*point[:3], [(10, 999)]), *rest]),
    }[what]()


SENTENCES = {
    "unknown model": r"cameras.*(unknown model 99|model '99' is unknown)",
    "NaN parameter": r"cameras.*not a finite number",
    "camera twice": r"cameras.*camera 7 is there twice",
    "no such camera": r"images.*image 10 has the camera 55, which is not among the cameras",
    "image twice": r"images.*image 10 is there twice",
    "no name": r"images.*(image 10 has no name|9 values instead of IMAGE_ID)",
    "NaN pixel": r"images.*(observation 1 of image 10 has no possible pixel|'nan' is not a finite number)",
    "infinite translation": r"images.*(the pose of image 10|'inf' is not a finite number)",
    "NaN point": r"points3D.*(record 1 of the points has no possible position|'nan' is not a finite number)",
    "far point": r"points3D.*(record 1 of the points has no possible position|is impossible)",
    "track of no image": r"points3D.*keypoint 0 of image 999, which does not exist",
    "point twice": r"points3D.*point 100 is there twice",
    "track of no keypoint": r"points3D.*keypoint 999 of image 10, which does not exist",
}


@pytest.mark.parametrize("files_of", [binary_files, text_files], ids=["binary", "text"])
@pytest.mark.parametrize("what", SENTENCES)
def test_what_is_wrong_is_said(what, files_of, rng, tmp_path):
    place = r"(\.bin, up to byte \d+: |\.txt, line \d+: )"
    words = SENTENCES[what].replace(".*", place + ".*", 1)
    with pytest.raises(InputError, match=words):
        read_model(write(tmp_path, files_of(changed(sample_model(rng), what))))


@pytest.mark.parametrize("files_of", [binary_files, text_files], ids=["binary", "text"])
@pytest.mark.parametrize(
    "change, words",
    [
        (lambda s: replace(s, rigs=s.rigs * 2), r"rigs.*rig 3 is there twice"),
        (lambda s: replace(s, rigs=[(3, [*s.rigs[0][1], (77, np.eye(3, 4))])]), r"rigs.*not among the cameras"),
        (lambda s: replace(s, frames=[(*f[:1], 9, *f[2:]) for f in s.frames]), r"frames.*frame 50 is of rig 9"),
        (lambda s: replace(s, frames=s.frames[:1]), r"images.*no frame has image 12"),
        (lambda s: replace(s, frames=[*s.frames, (60, *s.frames[0][1:])]), r"frames.*image 10 is in two frames"),
        (
            lambda s: replace(s, frames=[(*s.frames[0][:3], [(42, 10)]), *s.frames[1:]]),
            r"frames.*camera 42, which is not in its rig 3",
        ),
        (
            lambda s: replace(s, frames=[(*s.frames[0][:3], [(7, 11), (8, 10)]), *s.frames[1:]]),
            r"images.*no frame has image 10 with its camera 7",
        ),
    ],
)
def test_rigs_and_frames_must_agree(change, words, files_of, rng, tmp_path):
    sample = change(with_rigs(sample_model(rng), rng))
    with pytest.raises(InputError, match=words):
        read_model(write(tmp_path, files_of(sample)))
