"""Writes what the documentation takes from the program itself: ``python -m scripts.documentation``.

These are the page of all commands, from the help that they print, and the picture of the rooms and floors, from the
test that keeps them. A test compares both with what is in docs/.
"""

import contextlib
import io
import os
from pathlib import Path
from unittest import mock

from scripts.drawing import Drawing
from spherloc_viz.commands.cli import app
from tests.test_walls import FLOORS, MODULES, ROOT

COMMANDS = ROOT / "docs" / "reference" / "commands.md"
HOUSE = ROOT / "docs" / "pictures" / "floors.svg"
WIDTH = "100"
INTRODUCTION = """# Commands

What every command takes, as `spherloc COMMAND --help` prints it. `python -m scripts.documentation` writes this page,
and a test compares it with the program.

Every command ends with 2 and one sentence if an input cannot be used, and with 130 after Ctrl-C.
"""


def help_of(*words: str) -> str:
    """What a command prints as its help."""
    output = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")  # boxes are drawn for UTF-8 only
    with (
        mock.patch.dict(os.environ, {"COLUMNS": WIDTH, "NO_COLOR": "1"}),
        contextlib.redirect_stdout(output),
        contextlib.suppress(SystemExit),
    ):
        app.cli(prog="spherloc", args=[*words, "--help"], sort_subcommands=False)
    output.seek(0)
    return output.read()


def commands() -> list[str]:
    """Names of all commands, in the order of the help."""
    usage = help_of().split("{", 1)[1].split("}", 1)[0]
    return usage.split(",")


def commands_page() -> str:
    """The page of all commands."""
    return "\n".join([INTRODUCTION, *map(_section, commands())])


def _section(command: str) -> str:
    text = help_of(command).strip()
    said, box, options = text.partition("╭")
    usage, *paragraphs = said.strip().split("\n\n")
    parts = [f"## {command}", f"```text\n{usage}\n```"]
    examples = [paragraph for paragraph in paragraphs if paragraph.startswith("spherloc ")]
    parts += [paragraph for paragraph in paragraphs if paragraph not in [*examples, "For example:"]]
    if examples:
        parts.append(
            "For example:\n\n```sh\n" + "\n".join(example.replace("\n", " ") for example in examples) + "\n```"
        )
    lines = [line.rstrip() for line in (box + options).splitlines()]
    return "\n\n".join([*parts, "```text\n" + "\n".join(lines) + "\n```"]) + "\n"


ROW, ROOM_W, COLUMNS, LEFT, GAP, TOP = 30, 158, 5, 56, 8, 52
CORE, SCREEN = "#1f4e79", "#5a4a1f"
"""Colours of rooms without a screen, and of those with one."""


def house() -> str:
    """The rooms by floor, from the ground up, as SVG."""
    heights = [-(-len(floor) // COLUMNS) for floor in FLOORS]
    height = TOP + sum(count * (ROW + GAP) + 2 * GAP for count in heights) + 58
    width = LEFT + COLUMNS * (ROOM_W + GAP) + 20
    drawing = Drawing(
        width, height, "The rooms of spherloc by floor; a file imports from its own floor and those below"
    )
    drawing.text(20, 32, "a file imports from its own floor and from those below", size=15)
    y = TOP
    for number in reversed(range(len(FLOORS))):
        rooms = [room for room in FLOORS[number] if _exists(room)]
        rows = -(-len(rooms) // COLUMNS)
        drawing.text(20, y + GAP + 20, str(number), size=15, color="#8c97a8")
        for place, room in enumerate(rooms):
            column, row = place % COLUMNS, place // COLUMNS
            package, _, name = room.partition(".")
            x, top = LEFT + column * (ROOM_W + GAP), y + GAP + row * (ROW + GAP)
            drawing.box(x, top, ROOM_W, ROW, CORE if package == "spherloc" else SCREEN)
            is_package = bool(name) and (ROOT / package / name / "__init__.py").exists()
            label = f"{name}/" if is_package else name or f"{package} itself"
            drawing.text(x + ROOM_W / 2, top + 20, label, size=13, anchor="middle")
        y += rows * (ROW + GAP) + 2 * GAP
        if number:
            wall = _is_core(number) != _is_core(number - 1)
            drawing.line((20, y), (width - 20, y), "#d5463c" if wall else "#3a4352", 3 if wall else 1)
    for place, (color, words) in enumerate(((CORE, "spherloc: knows no screen"), (SCREEN, "spherloc_viz: draws"))):
        drawing.box(LEFT + 230 * place, y + 18, 20, 20, color)
        drawing.text(LEFT + 230 * place + 28, y + 33, words, size=13)
    drawing.line((LEFT + 420, y + 28), (LEFT + 450, y + 28), "#d5463c", 3)
    drawing.text(LEFT + 458, y + 33, "the wall between them", size=13)
    drawing.height = y + 52
    return drawing.svg()


def _exists(room: str) -> bool:
    return any(name == room or name.startswith(f"{room}.") for name in MODULES)


def _is_core(number: int) -> bool:
    return FLOORS[number][0].partition(".")[0] == "spherloc"


def files() -> dict[Path, str]:
    """What is to be written, by its path."""
    return {COMMANDS: commands_page(), HOUSE: house()}


if __name__ == "__main__":
    for path, text in files().items():
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")
        print(path.relative_to(ROOT))
