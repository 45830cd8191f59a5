"""The documents and pictures of the repository: pictures open, and links lead somewhere."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import unquote

import pytest
from PIL import Image

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
DOCUMENTS = sorted(
    [*ROOT.glob("*.md"), *DOCS.rglob("*.md"), *(ROOT / "examples").rglob("*.md"), *(ROOT / "sb3_uav").rglob("*.md")]
)
# Without the built site (`make docs`), whose theme has small icons.
PNGS = sorted(path for path in DOCS.rglob("*.png") if "_build" not in path.relative_to(DOCS).parts)
PDFS = sorted(DOCS.rglob("*.pdf"))
# [text](target), ![text](target "title") and [name]: target
(REPOSITORY,) = re.findall(r"^url = (\S+)$", (ROOT / "setup.cfg").read_text(encoding="utf-8"), flags=re.MULTILINE)
OURS = re.compile(rf"(?:{REPOSITORY}/(?:blob|tree)|{REPOSITORY.replace('github', 'raw.githubusercontent')})/main/")
LINK = re.compile(r"\]\(\s*<?([^)\s>]+)>?(?:\s+\"[^\"]*\")?\s*\)|^\[[^\]]+\]:\s*(\S+)", re.MULTILINE)


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("path", PNGS, ids=relative)
def test_pictures_open(path: Path) -> None:
    """Text edited inside a PNG breaks the checksum of its chunk."""
    with Image.open(path) as picture:
        picture.verify()
    with Image.open(path) as picture:
        picture.load()
        assert min(picture.size) > 100 and len(picture.convert("RGB").getcolors(2**24) or ()) > 2


def check_pdf(content: bytes) -> None:
    """Its table says where each object begins: text that was edited shifts them."""
    assert content.startswith(b"%PDF-") and content.rstrip().endswith(b"%%EOF")
    start = int(content.rsplit(b"startxref", 1)[1].split()[0])
    table = re.match(rb"xref\s+0 (\d+)\s+", content[start:])
    assert table, f"byte {start} holds {content[start : start + 20]!r}, not the table of objects"
    entries = [content[start + table.end() + 20 * number :][:20] for number in range(int(table.group(1)))]
    assert len(entries) > 5
    for number, entry in enumerate(entries):
        offset, generation, kind = entry.split()
        expected = b"%d %d obj" % (number, int(generation))
        assert kind == b"f" or content[int(offset) :].startswith(expected), f"object {number} is not at byte {int(offset)}"


@pytest.mark.parametrize("path", PDFS, ids=relative)
def test_pdfs_are_whole(path: Path) -> None:
    check_pdf(path.read_bytes())


def test_an_edited_pdf_is_noticed() -> None:
    content = PDFS[0].read_bytes()
    edited = re.sub(rb"Machine: \w+", b"Machine: a longer text than before", content, count=1)
    assert edited != content
    with pytest.raises(AssertionError):
        check_pdf(edited)


def without_code(text: str) -> str:
    return re.sub(r"^(```|~~~).*?^\1|`[^`\n]+`", "", text, flags=re.DOTALL | re.MULTILINE)


def anchors(path: Path) -> set[str]:
    """Of all headings, as GitHub makes them."""
    found: dict[str, int] = {}
    names = set()
    text = re.sub(r"^(```|~~~).*?^\1", "", path.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    for heading in re.findall(r"^#{1,6}\s+(.*?)\s*#*$", text, flags=re.MULTILINE):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading)
        name = re.sub(r"[^\w\- ]", "", plain.lower()).replace(" ", "-")
        names.add(f"{name}-{found[name]}" if name in found else name)
        found[name] = found.get(name, 0) + 1
    return names | set(re.findall(r"<a (?:id|name)=\"([^\"]+)\"", text))


def links() -> list[tuple[Path, str]]:
    pairs = []
    for document in DOCUMENTS:
        for match in LINK.finditer(without_code(document.read_text(encoding="utf-8"))):
            target = match.group(1) or match.group(2)
            # Absolute links into this repository, such as the README has, lead to the same files.
            path = OURS.sub(f"{Path('../' * (len(document.relative_to(ROOT).parts) - 1)).as_posix()}/", target)
            if not re.match(r"[a-z]+:", path):
                pairs.append((document, path))
    return pairs


@pytest.mark.parametrize("document, target", links(), ids=lambda part: relative(part) if isinstance(part, Path) else part)
def test_links_lead_somewhere(document: Path, target: str) -> None:
    """To a file or a folder, and to a heading of it if they name one."""
    name, _, anchor = target.partition("#")
    path = (document.parent / unquote(name)).resolve() if name else document
    assert path.is_relative_to(ROOT) and path.exists(), f"{relative(document)}: {target}"
    assert not anchor or anchor in anchors(path), f"{relative(document)}: {target}; there are {sorted(anchors(path))}"


def test_the_readme_has_absolute_links_only() -> None:
    """Package indexes show it too, and resolve no others."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    targets = [match.group(1) or match.group(2) for match in LINK.finditer(without_code(readme))]
    assert len([target for target in targets if OURS.match(target)]) > 15
    assert [target for target in targets if not target.startswith("https://")] == []
    # Pictures come from where files are served as they are.
    assert all("raw.githubusercontent.com" in target for target in re.findall(r"!\[[^\]]*\]\((\S+)\)", readme))


def test_every_file_names_the_same_repository() -> None:
    pages = [*DOCUMENTS, ROOT / "CITATION.cff", ROOT / "setup.cfg", *(ROOT / ".github").rglob("*.yml")]
    for path in pages:
        for found in re.findall(
            r"https://(?:raw\.githubusercontent|github)\.com/([\w-]+/sb3[_-]uav)\b", path.read_text(encoding="utf-8")
        ):
            assert REPOSITORY.endswith(f"/{found}"), relative(path)
