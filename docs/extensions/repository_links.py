"""
Links of the pages to files of the repository, which work on GitHub as they stand.

Such a link leads to the page that includes the file, if there is one. Otherwise it leads to the repository on the web, if
``setup.cfg`` names it among its project URLs; otherwise to a copy of the file, or nowhere where it is a folder.
"""

from __future__ import annotations

import configparser
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform

DOCS = Path(__file__).parents[1]
ROOT = DOCS.parent
# Pages that include a file from elsewhere in the repository.
INCLUDED = {
    "CHANGELOG.md": "changelog",
    "CONTRIBUTING.md": "contributing",
    "README.md": "index",
    "examples/missions/README.md": "mission_examples",
    "sb3_uav/pretrained/universal/README.md": "pretrained/universal",
    "sb3_uav/pretrained/world/README.md": "pretrained/world",
}


def repository_url() -> str | None:
    """:return: The address of the repository, by the project URLs of ``setup.cfg``; None if it is not among them"""
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg", encoding="utf-8")
    for line in config["metadata"].get("project_urls", "").splitlines():
        name, _, url = line.partition("=")
        if name.strip().lower() in ("source", "source code", "repository"):
            return url.strip().rstrip("/")
    return None


class RepositoryLinks(SphinxTransform):
    """Resolves what MyST leaves open or would copy: links to folders, and to files that are no pages."""

    # Before the files to download are collected, which is done when all transforms are over.
    default_priority = 100

    def apply(self, **_: Any) -> None:
        for kind in (addnodes.pending_xref, addnodes.download_reference):
            for node in list(self.document.findall(kind)):
                path = self._path(node) if node.get("reftype") == "myst" else None
                if path is not None:
                    self._resolve(node, path)

    def _path(self, node: Any) -> Path | None:
        """
        :param node: A link
        :return: What it leads to, relative to the repository; None if it is a page, or nothing in the repository
        """
        target = unquote(node["reftarget"]).partition("#")[0]
        if node.get("refdomain") == "doc":
            if target in self.env.found_docs:
                return None
            path = DOCS / f"{target}.md"
        else:
            path = Path(self.env.doc2path(self.env.docname)).parent / target
        path = path.resolve()
        if not target or not path.exists() or not path.is_relative_to(ROOT):
            return None
        readme = path / "README.md"
        return (readme if readme.is_file() else path).relative_to(ROOT)

    def _resolve(self, node: Any, path: Path) -> None:
        """
        :param node: The link, which is replaced
        :param path: What it leads to, relative to the repository
        """
        page = INCLUDED.get(path.as_posix())
        if page is None and path.parts[0] == "docs" and path.suffix == ".md":
            page = path.relative_to("docs").with_suffix("").as_posix()
        url = repository_url()
        link: Any
        if page is not None:
            link = addnodes.pending_xref(refdomain="doc", reftype="myst", refexplicit=True, reftarget=page)
            link["refdoc"], link["reftargetid"] = self.env.docname, node.get("reftargetid")
        elif url is not None and path.parts[0] != "docs":
            kind = "tree" if (ROOT / path).is_dir() else "blob"
            link = nodes.reference(refuri=f"{url}/{kind}/main/{quote(path.as_posix())}", internal=False)
        elif (ROOT / path).is_dir():
            link = nodes.inline()
        else:
            # The file is copied into the site.
            return
        link += [child.deepcopy() for child in node.children]
        node.replace_self(link)


def setup(app: Sphinx) -> dict[str, bool]:
    """
    :param app: Sphinx
    :return: That its processes may work side by side
    """
    app.add_transform(RepositoryLinks)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
