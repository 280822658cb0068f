"""The documentation is true: its links lead somewhere, its examples run and print what it says, its commands exist."""

import contextlib
import functools
import importlib
import io
import os
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import tyro
import yaml

from scripts import documentation
from spherloc import registry
from spherloc.metrics import SUCCESS_DEG, SUCCESS_M
from spherloc_viz.app.catalog import Catalog
from spherloc_viz.app.glossary import TERMS
from spherloc_viz.app.session import DIAGNOSE_AFTER_S, QUIET_S
from spherloc_viz.commands import cli
from spherloc_viz.gallery import gallery_cases
from spherloc_viz.recording.storage.room import KEEP_GIGABYTES
from tests.needs import needs
from tests.waiting import LIMIT_S

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "benchmarks/README.md")),
    *sorted(DOCS.rglob("*.md")),
]
OWN_TESTS = {"extending.md"}
"""A page whose examples are whole packages, which its own tests build and run."""
IDS = [str(page.relative_to(ROOT)) for page in PAGES]
every_page = pytest.mark.parametrize("page", PAGES, ids=IDS)

FENCE = re.compile(r"^( *)```(\w*)([^\n]*)\n(.*?)^\1```\s*$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
WORDS = (
    *("2P", "aligned frame", "alternative pose", "ball", "bearing", "bound", "candidate yaw", "certificate", "clique"),
    *("consensus", "doubtful", "frame", "gap", "key step", "latest-only worker", "layer", "level pose", "map scene"),
    *("match", "NFA", "painter", "plan", "primitive", "query", "reference", "replay", "root", "rotation graph"),
    *("run library", "run request", "sandbox", "sequence", "stage", "step", "storage", "support", "trace"),
    *("translation graph", "yaw arc"),
)
"""Some that the glossary must have besides those of the page."""


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    language: str
    mark: str
    """What stands beside the language: a title marks an example that needs the reader's own files."""
    text: str
    line: int


def blocks(page: Path) -> list[Block]:
    """Fenced blocks in their order, without the indentation that lists give them."""
    text = page.read_text("utf-8")
    return [
        Block(
            found[2],
            found[3].strip(),
            re.sub(rf"^{found[1]}", "", found[4], flags=re.MULTILINE),
            text.count("\n", 0, found.start()) + 1,
        )
        for found in FENCE.finditer(text)
    ]


def prose(page: Path) -> str:
    """A page without its blocks."""
    return FENCE.sub("", page.read_text("utf-8"))


def anchors(page: Path) -> set[str]:
    """Names that links can give to places of a page: its headings in small letters, without signs."""
    headings = re.findall(r"^#+ (.+)$", FENCE.sub("", page.read_text("utf-8")), re.MULTILINE)
    return {re.sub(r"\s+", "-", re.sub(r"[^\w\s-]", "", heading.lower())).strip("-") for heading in headings}


@every_page
def test_links_lead_somewhere(page: Path) -> None:
    broken = []
    for target in LINK.findall(prose(page)):
        if re.match(r"https?://", target):
            continue
        name, _, anchor = target.partition("#")
        other = (page.parent / name).resolve() if name else page
        if not other.exists() or (anchor and anchor not in anchors(other)):
            broken.append(target)
    assert not broken


@every_page
def test_no_page_needs_a_network_to_look_right(page: Path) -> None:
    assert not re.findall(r"!\[[^\]]*\]\(https?:", page.read_text("utf-8"))


def python_pages() -> list[Path]:
    """Pages with Python examples; the README's is run by the tests of ``spherloc.localize``."""
    own = {*OWN_TESTS, "README.md"}
    return [page for page in PAGES if page.name not in own and any(b.language == "python" for b in blocks(page))]


@pytest.mark.parametrize("page", python_pages(), ids=lambda page: page.name)
def test_python_examples_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of a page share their names, and print what the block below them says."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    found = blocks(page)
    for block, following in zip(found, [*found[1:], None], strict=True):
        if block.language != "python":
            continue
        code = compile("\n" * block.line + block.text, str(page), "exec")
        if block.mark:
            assert re.match(r'title="(With|In) .*your', block.mark), f"line {block.line}: what does the mark mean?"
            continue
        output = io.StringIO()
        with contextlib.redirect_stdout(output):
            exec(code, names)
        said = following.text if following is not None and following.language == "text" else ""
        assert output.getvalue() == said, f"line {block.line}"


def command_lines(page: Path) -> Iterator[tuple[list[str], bool]]:
    """Words of every command line that begins with spherloc, and whether it is whole."""
    for block in blocks(page):
        if block.language == "sh":
            for line in block.text.replace("\\\n", " ").splitlines():
                words = shlex.split(line, comments=True)
                if words[:1] and words[0].rpartition("/")[2] == "spherloc":
                    yield words[1:], True
    for line in re.findall(r"`spherloc ([^`]+)`", prose(page)):
        yield shlex.split(line.replace("\n", " ")), False


def command(name: str) -> Callable[..., object] | None:
    """The function of a command; None if there is no such command."""
    if name not in documentation.commands():
        return None
    return next(command for command in cli.COMMANDS if command.__name__ == name.replace("-", "_"))


@functools.cache
def flags_of(name: str) -> frozenset[str]:
    """All flags of a command."""
    return frozenset(re.findall(r"(?<![\w-])--[a-z][a-z0-9-]*", documentation.help_of(name)))


@pytest.mark.parametrize("page", [page for page in PAGES if list(command_lines(page))], ids=lambda page: page.name)
def test_commands_exist(page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Whole command lines are parsed by the program itself; of those within a sentence, the command and its flags."""
    for words, whole in command_lines(page):
        if words[0] in ("--help", "COMMAND"):
            continue
        function = command(words[0])
        assert function is not None, f"spherloc {shlex.join(words)}: there is no such command"
        if not whole:
            flags = {word.partition("=")[0] for word in words if word.startswith("--")} - {"--help"}
            assert flags <= flags_of(words[0]), shlex.join(words)
            continue

        @functools.wraps(function)
        def parsed(*given, **named) -> None:
            """What is parsed is not run."""

        try:
            tyro.cli(parsed, args=words[1:])
        except SystemExit:
            pytest.fail(f"spherloc {shlex.join(words)}\n{capsys.readouterr()}")


@pytest.mark.parametrize("path", [documentation.COMMANDS, documentation.HOUSE], ids=lambda path: path.name)
def test_what_comes_from_the_program_is_up_to_date(path: Path) -> None:
    """The words of each command: layout, brackets and remarks like "required" differ with tyro's version."""

    def words(text: str) -> dict[str, set[str]]:
        text = re.sub(r"(?m)^usage: .*$", "", text)
        parts = re.split(r"(?m)^## (\S+)$", "## start\n" + text)
        found = {
            name: set(re.findall(r"[\w./~-]*\w", part)) for name, part in zip(parts[1::2], parts[2::2], strict=True)
        }
        return {name: seen - {"required", "default"} for name, seen in found.items()}

    wanted = documentation.files()[path]
    assert words(path.read_text("utf-8")) == words(wanted), "run: python -m scripts.documentation"


def glossary() -> list[str]:
    """Terms of the glossary in their order."""
    return re.findall(r"^- \*\*(.+?)\*\*: ", (DOCS / "glossary.md").read_text("utf-8"), re.MULTILINE)


def test_the_glossary_is_whole_and_sorted() -> None:
    terms = glossary()
    assert terms == sorted(terms, key=str.lower) and len(set(terms)) == len(terms)
    assert set(TERMS) | set(WORDS) <= set(terms)


@every_page
def test_named_files_exist(page: Path) -> None:
    """What stands in backticks and looks like a file of the project is one."""
    named = re.findall(
        r"`((?:spherloc|spherloc_viz|tests|scripts|benchmarks|docs|scenes|examples)/[\w./-]+)", prose(page)
    )
    named += [f"{name.replace('.', '/')}.py" for name in re.findall(r"`(?:python -m )?(scripts\.\w+)`", prose(page))]
    assert not [name for name in named if not (ROOT / name).exists()]


def options_of(benchmark: Path) -> set[str]:
    """Options in a benchmark's source and in the benchmarks that it imports, which may read its command line."""
    source = benchmark.read_text("utf-8")
    names = re.findall(r"^from benchmarks\.(\w+) import", source, re.MULTILINE)
    imported = [path for name in names if (path := ROOT / "benchmarks" / f"{name}.py").is_file()]
    texts = [source, *(path.read_text("utf-8") for path in imported)]
    return {option for text in texts for option in re.findall(r'"(--[a-z-]+)"', text)}


@every_page
def test_named_benchmarks_exist(page: Path) -> None:
    """With the options that are named."""
    for name, words in re.findall(r"-m benchmarks\.(\w+)([^`#\n]*)", page.read_text("utf-8")):
        module = ROOT / "benchmarks" / name
        source = (module / "__main__.py") if module.is_dir() else module.with_suffix(".py")
        assert source.is_file(), name
        assert set(re.findall(r" (--[a-z-]+)", words)) <= options_of(source), name


@every_page
def test_named_targets_of_make_exist(page: Path) -> None:
    targets = set(re.findall(r"^([a-z-]+):.*##", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE))
    shell = "".join(block.text for block in blocks(page) if block.language == "sh")
    named = re.findall(r"`make ([a-z-]+)", prose(page)) + re.findall(r"^make ([a-z-]+)", shell, re.MULTILINE)
    assert set(named) <= targets


def documented() -> list[str]:
    """Everything that a page of the reference takes from docstrings."""
    pages = (DOCS / "reference").glob("*.md")
    return sorted(
        {name for page in pages for name in re.findall(r"^::: (\S+)$", page.read_text("utf-8"), re.MULTILINE)}
    )


def test_what_the_reference_names_exists_and_has_a_docstring() -> None:
    for name in documented():
        try:
            thing = importlib.import_module(name)
        except ImportError:
            module, _, attribute = name.rpartition(".")
            thing = getattr(importlib.import_module(module), attribute)
        assert thing.__doc__, name


def test_the_reference_has_all_that_the_package_exports() -> None:
    import spherloc

    homes = {name: getattr(getattr(spherloc, name), "__name__", name) for name in spherloc.EXPORTS}
    text = "\n".join(page.read_text("utf-8") for page in (DOCS / "reference").glob("*.md"))
    assert not [name for name, real in homes.items() if not re.search(rf"(\.|\b){re.escape(real)}\b", text)]


def test_every_estimator_is_in_the_table_of_the_start() -> None:
    text = (DOCS / "start.md").read_text("utf-8")
    named = set(re.findall(r"`([a-z0-9-]+)`", text[text.index("## Which estimator?") :]))
    own = {name for name in registry.names("estimators") if not registry.extension_of("estimators", name)}
    assert own <= named


def test_numbers_in_words_are_those_of_the_code() -> None:
    """Those that no example prints."""
    text = {page.name: page.read_text("utf-8") for page in PAGES}
    assert f"nothing changed for {QUIET_S:g} s" in text["architecture.md"]
    assert f"stood still for {DIAGNOSE_AFTER_S:g} s" in text["architecture.md"]
    assert f"more than {KEEP_GIGABYTES:g} GB" in text["CHANGELOG.md"]
    assert abs(len(gallery_cases()) - 24) <= 2, "two dozen, says docs/concepts.md"
    assert f"less than {SUCCESS_DEG:g} degree and less than {SUCCESS_M:g} m" in text["glossary.md"]
    first = next(iter(Catalog(None).scenes.values())).problem(seed=0)
    assert first.truth_inliers is not None
    wrong = len(first) - first.truth_inliers.sum()
    assert f"with {len(first)} matches,\nof which {wrong} are wrong" in text["start.md"]


def test_every_page_has_its_place_in_the_site() -> None:
    table = yaml.safe_load((ROOT / "mkdocs.yml").read_text("utf-8"))

    def leaves(node) -> list[str]:
        parts = node.values() if isinstance(node, dict) else node
        return [node] if isinstance(node, str) else [leaf for part in parts for leaf in leaves(part)]

    pages = {page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md")}
    assert sorted(leaves(table["nav"])) == sorted(pages)


def test_the_citation_is_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert (citation["title"], citation["version"], citation["license"]) == (
        project["name"],
        project["version"],
        project["license"],
    )
    assert citation["authors"] == [{"name": "spherloc contributors"}] and citation["type"] == "software"
    assert f"({project['version']})" in (ROOT / "CHANGELOG.md").read_text("utf-8")


@needs("mkdocs")
def test_the_site_is_built_without_a_warning_and_reaches_for_nothing(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        words, cwd=ROOT, capture_output=True, text=True, timeout=LIMIT_S, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr
    for page in (tmp_path / "site").rglob("*.html"):
        text = page.read_text("utf-8")
        assert not re.findall(r'<(?:script|img|iframe)[^>]* src="https?:', text), page
        assert not re.findall(r'<link[^>]* rel="stylesheet"[^>]* href="https?:', text), page
