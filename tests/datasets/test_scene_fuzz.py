"""Whatever bytes a scene consists of: a scene, or one printable line that names a file. Never another exception."""

import json

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scene_texts import CSV, MEASURED, SYNTHETIC, write, write_measured

from spherloc.datasets import load_scene
from spherloc.errors import SpherlocError

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

EXAMPLES = settings(max_examples=60)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


def check(path):
    try:
        scene = load_scene(path)
    except SpherlocError as error:
        message = str(error)
        assert message.startswith(str(path.parent)) and message.isprintable(), f"{message!r}"
        assert len(message) < 1000
    else:
        assert scene.name and scene.camera.width > 0


PIECES = [b'"', b"[", b"]", b"\n", b"-", b"e", b"nan", b"9" * 400, b"\\u0000", b"=", b",", b"\xff"]


@st.composite
def mutations(draw, text):
    """A text with a few pieces overwritten, inserted, removed or repeated, and perhaps cut off."""
    data = bytearray(text.encode())
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(data)))
        size = draw(st.integers(0, 12))
        piece = draw(st.one_of(st.binary(max_size=4), st.sampled_from(PIECES)))
        repeat = data[at : at + size]
        data[at : at + draw(st.sampled_from([0, size]))] = draw(st.sampled_from([piece, bytes(repeat) * 2]))
    if draw(st.booleans()) and draw(st.booleans()):
        del data[draw(st.integers(0, len(data))) :]
    return bytes(data)


@EXAMPLES
@given(st.binary(max_size=200))
def test_any_bytes(folder, data):
    check(write(folder, data))


@EXAMPLES
@given(mutations(SYNTHETIC))
def test_mutated_synthetic_scene(folder, data):
    check(write(folder, data))


@EXAMPLES
@given(mutations(MEASURED))
def test_mutated_measured_scene(folder, data):
    check(write_measured(folder, data))


@EXAMPLES
@given(mutations(CSV))
def test_mutated_csv(folder, data):
    check(write_measured(folder, matches=data))


TEXT = st.text(max_size=8).map(lambda text: json.dumps(text).replace("\x7f", ""))
SCALARS = st.one_of(
    st.integers().map(str),
    st.integers(300, 6000).map("9".__mul__),
    st.integers(300, 6000).map(lambda n: "0x" + "f" * n),
    st.floats().map(lambda x: repr(x).replace("e", "E")),
    st.booleans().map(lambda b: str(b).lower()),
    TEXT,
    st.just("2020-01-31"),
    st.just("1979-05-27T07:32:00Z"),
)
VALUES = st.recursive(SCALARS, lambda inner: st.lists(inner, max_size=4).map(lambda items: f"[{', '.join(items)}]"))
PLACES = [(text, line) for text in (SYNTHETIC, MEASURED) for line in text.splitlines() if "=" in line]


@EXAMPLES
@given(st.sampled_from(PLACES), VALUES)
@example((MEASURED, "camera = [0.0, 1.0, 0.0]"), f"[0, {10**400}, 0]")
@example((SYNTHETIC, "seed = 4"), "0x" + "f" * 5000)
@example((SYNTHETIC, "seed = 4"), "9" * 5000)
@example((MEASURED, 'correspondences = "matches.csv"'), r'"\u0000"')
@example((SYNTHETIC, 'kind = "synthetic"'), r'"a\nb"')
def test_any_value_of_any_key(folder, place, value):
    """Every type where another is expected."""
    text, line = place
    check(write_measured(folder, text.replace(line, f"{line.split('=')[0]} = {value}", 1)))


@EXAMPLES
@given(st.lists(st.lists(st.text(max_size=6), max_size=8), max_size=5), st.booleans())
def test_any_cells(folder, rows, header):
    """Cells of any text, quoted as CSV does."""
    lines = [",".join('"' + cell.replace('"', '""') + '"' for cell in row) for row in rows]
    text = "\n".join((["u,v,X,Y,Z"] if header else []) + lines)
    check(write_measured(folder, matches=text.encode(errors="replace")))
