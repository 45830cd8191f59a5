"""The watched browser of the tests notices what it is there to notice."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from browser import running_browser, stays_here, visit_in

if TYPE_CHECKING:
    from playwright.sync_api import Browser


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with running_browser() as running:
        yield running


@pytest.mark.parametrize(
    ("url", "stays"),
    [
        ("file:///tmp/map.html", True),
        ("data:text/plain,1", True),
        ("http://127.0.0.1:8000/x", True),
        ("ws://localhost:1/", True),
        ("http://[::1]:80/", True),
        ("https://example.org/", False),
        ("http://127.0.0.1.example.org/", False),
        ("file://example.org/map.html", False),
        ("ftp://localhost/", False),
    ],
)
def test_what_leaves_the_machine(url: str, stays: bool) -> None:
    assert stays_here(url) is stays


@pytest.mark.parametrize(
    ("body", "complaint"),
    [
        ("<img src='http://example.org/tile.png'>", "left the machine"),
        ("<script>new WebSocket('ws://example.org/')</script>", "left the machine"),
        ("<script>fetch('//example.org/').catch(() => 0)</script>", "left the machine"),
        ("<script>console.error('bad')</script>", "console: bad"),
        ("<script>null.x</script>", "uncaught"),
        ("<script>alert(1)</script>", "dialog: 1"),
    ],
)
def test_a_bad_page_fails_the_test(browser: Browser, tmp_path: Path, body: str, complaint: str) -> None:
    page = tmp_path / "page.html"
    page.write_text(f"<!doctype html>{body}", encoding="utf-8")
    with pytest.raises(AssertionError, match=complaint), visit_in(browser) as visit:
        visit.page.goto(page.as_uri())
        visit.page.wait_for_timeout(100)


def test_a_good_page(browser: Browser, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    page.write_text("<!doctype html><title>good</title><script>console.error('as planned')</script>", encoding="utf-8")
    with visit_in(browser, allowed=("as planned",)) as visit:
        visit.page.goto(page.as_uri())
        assert visit.page.title() == "good"
        assert visit.requests == [page.as_uri()]
