"""The documentation site: no warning, no dead link, nothing from elsewhere; what is generated is fresh, and notebooks run."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest

from scripts import draw_diagrams, make_yaml_keys

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(
    path.relative_to(DOCS).with_suffix("").as_posix() for kind in ("md", "rst", "ipynb") for path in DOCS.rglob(f"*.{kind}")
)


class Page(HTMLParser):
    """
    :param path: A page of the site
    :ivar ids: Its anchors
    :ivar links: Targets of its links
    :ivar loaded: What a browser fetches to show it
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.ids |= {given["id"]} if "id" in given else set()
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        elif tag == "link" and given.get("rel") in ("stylesheet", "icon", "preload"):
            self.loaded.append(given["href"])
        elif "src" in given:
            self.loaded.append(given["src"])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    for package in ("sphinx", "furo", "myst_nb", "sphinx_copybutton"):
        pytest.importorskip(package)
    folder = tmp_path_factory.mktemp("site") / "html"
    # Of the target `docs` of the Makefile. The doctrees stay out of what is checked.
    (command,) = re.findall(r"-m (sphinx .*) docs docs/_build/html", (ROOT / "Makefile").read_text(encoding="utf-8"))
    words = [sys.executable, "-m", *command.split(), "-q", "-d", str(folder.parent / "doctrees"), "docs", str(folder)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Page]:
    return {
        path: Page(path)
        for path in sorted(site.rglob("*.html"))
        if "_static" not in path.parts and "_downloads" not in path.parts
    }


def repository_links() -> Any:
    """:return: The extension of the site that resolves links into the repository"""
    pytest.importorskip("sphinx")
    spec = importlib.util.spec_from_file_location("repository_links", DOCS / "extensions" / "repository_links.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_every_page_is_reached_from_the_navigation(site: Path, pages: dict[Path, Page]) -> None:
    """Sphinx warns, which fails the build; but pages that say `orphan` are exempt from that."""
    assert len(PAGES) > 60
    seen, left = set(), [site / "index.html"]
    while left:
        page = left.pop()
        if page in seen or page not in pages:
            continue
        seen.add(page)
        left += [(page.parent / unquote(urlsplit(link).path)).resolve() for link in pages[page].links if urlsplit(link).path]
    assert {site / f"{page}.html" for page in PAGES} <= seen


@pytest.mark.slow
def test_links_and_anchors_lead_somewhere(site: Path, pages: dict[Path, Page]) -> None:
    wrong = []
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            anchor = unquote(parts.fragment)
            if not target.is_file() or (anchor and target in pages and anchor not in pages[target].ids):
                wrong.append(f"{path.relative_to(site)}: {link}")
    assert wrong == []


@pytest.mark.slow
def test_pages_load_nothing_from_elsewhere(site: Path, pages: dict[Path, Page]) -> None:
    for path, page in pages.items():
        for source in page.loaded:
            parts = urlsplit(source)
            assert parts.scheme == "data" or not (parts.scheme or parts.netloc), f"{path.relative_to(site)}: {source}"
            assert parts.scheme == "data" or (path.parent / unquote(parts.path)).is_file(), (
                f"{path.relative_to(site)}: {source}"
            )
    for sheet in site.rglob("*.css"):
        assert not re.search(r"(@import|url\()\s*['\"]?(https?:)?//", sheet.read_text(encoding="utf-8")), sheet


@pytest.mark.slow
def test_links_into_the_repository_name_files_that_exist(pages: dict[Path, Page]) -> None:
    """On the site they lead to the repository on the web."""
    url = repository_links().repository_url()
    assert url is not None
    found = {link for page in pages.values() for link in page.links if re.match(rf"{re.escape(url)}/(blob|tree)/main/", link)}
    assert any(link.endswith("examples/knapsack.py") for link in found)
    for link in found:
        assert (ROOT / unquote(link.split("/main/")[1].partition("#")[0])).exists(), link


def test_included_pages_exist() -> None:
    for file, page in repository_links().INCLUDED.items():
        assert (ROOT / file).is_file() and (DOCS / f"{page}.md").is_file()
        text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
        assert page == "index" or f"{{include}} {'../' * (page.count('/') + 1)}{file}" in text


# ------------------------------------------------------------------------------------------------------ generated parts


def test_the_page_of_yaml_keys_is_fresh() -> None:
    """`python scripts/make_yaml_keys.py` writes it."""
    assert make_yaml_keys.PAGE.read_text(encoding="utf-8") == make_yaml_keys.text()


def test_no_yaml_key_is_missing() -> None:
    """Neither one that the front end knows, nor one that a shipped file uses."""
    yaml = pytest.importorskip("yaml")
    pytest.importorskip("rl_zoo3")
    from sb3_uav.zoo.configs import _ZOO_KEYS

    page = make_yaml_keys.PAGE.read_text(encoding="utf-8")
    keys = set(re.findall(r"^\| `(\w+)` \|", page, flags=re.MULTILINE))
    assert _ZOO_KEYS <= keys
    entries = yaml.safe_load((ROOT / "zoo_configs" / "reinforce.yml").read_text(encoding="utf-8"))
    used: set[str] = set()
    left = [entry for name, entry in entries.items() if re.search(r"-v\d+$", name)]
    assert len(left) > 10
    while left:
        node = left.pop()
        if isinstance(node, dict):
            used |= {key for key in node if "." not in key}
            left += node.values()
        elif isinstance(node, list):
            left += node
    # `algo` is the router's, whose other keys are those of its algorithm.
    assert used - keys <= {"algo"}


def test_the_diagrams_are_fresh(tmp_path: Path) -> None:
    """`python scripts/draw_diagrams.py` draws them."""
    draw_diagrams.main(tmp_path)
    drawn = sorted(tmp_path.iterdir())
    assert len(drawn) == 4
    for path in drawn:
        assert (draw_diagrams.FOLDER / path.name).read_text(encoding="utf-8") == path.read_text(encoding="utf-8")


def test_the_hosted_site_is_built_as_here() -> None:
    yaml = pytest.importorskip("yaml")
    settings = yaml.safe_load((ROOT / ".readthedocs.yaml").read_text(encoding="utf-8"))
    assert settings["sphinx"] == {"configuration": "docs/conf.py", "fail_on_warning": True}
    (install,) = settings["python"]["install"]
    assert set(install["extra_requirements"]) == {"all", "docs"}


# ------------------------------------------------------------------------------------------------------ notebooks


@pytest.mark.slow
@pytest.mark.parametrize("name", ["plan_a_mission", "train_a_policy"])
def test_notebooks_run(name: str) -> None:
    """And they are stored with outputs of the same kinds, pictures included: `python scripts/run_notebooks.py`."""
    for package in ("nbclient", "ipykernel", "plotly", "rl_zoo3", "numba"):
        pytest.importorskip(package)
    from scripts import run_notebooks

    path = run_notebooks.FOLDER / f"{name}.ipynb"
    stored, ran = json.loads(path.read_text(encoding="utf-8")), run_notebooks.run(path)
    kinds = [[output["output_type"] for output in cell.get("outputs", ())] for cell in stored["cells"]]
    assert kinds == [[output["output_type"] for output in cell.get("outputs", ())] for cell in ran.cells]
    assert any("image/png" in output.get("data", {}) for cell in stored["cells"] for output in cell.get("outputs", ()))
    # No paths of the machine that made the outputs.
    assert str(ROOT) not in json.dumps(stored) and not re.search(r"/(?:home|root|tmp|Users)/", json.dumps(stored))
