"""The built book as a reader gets it: pages, links, pictures, numbers; and nothing that needs a network."""

import ast
import re
from functools import cache
from pathlib import Path
from urllib.parse import unquote, urlsplit

import nbformat
import pytest
from bs4 import BeautifulSoup, Tag

from chapters import NOTEBOOKS, SOURCE, book_pages

MODULES = [file for file in sorted(SOURCE.rglob("[!.]*.py")) if not file.name.startswith("__")]
OF_THE_BUILDER = {"genindex.html", "search.html"}


@cache
def read_page(path: Path) -> BeautifulSoup:
    return BeautifulSoup(path.read_text(encoding="utf-8"), "html.parser")


@cache
def anchors_of(path: Path) -> set[str]:
    named = read_page(path).find_all("a", attrs={"name": True})
    return {tag["id"] for tag in read_page(path).find_all(id=True)} | {tag["name"] for tag in named}


@cache
def entries_of(path: Path) -> dict[str, Tag]:
    """Find the heads of the entries of a page on a module, by the names of what they describe."""
    return {head["id"]: head for head in read_page(path).find_all("dt", id=True)}


@pytest.fixture
def html(profile: dict) -> Path:
    return Path(profile["book_dir"], "_build", "html").resolve()


def pages_of(html: Path) -> list[Path]:
    return [page for page in sorted(html.rglob("*.html")) if "_static" not in page.relative_to(html).parts]


def is_inside(address: str) -> bool:
    return not urlsplit(address).scheme and not urlsplit(address).netloc


def test_every_chapter_has_its_page_with_a_title_of_its_own(profile: dict, html: Path) -> None:
    titles = [
        read_page(html / "notebooks" / f"{run.chapter}.html").h1.get_text() for run in book_pages(profile)
    ]
    assert len(set(titles)) == len(titles)


def test_every_page_can_be_reached_from_the_first(html: Path) -> None:
    """By the lists of contents at the side: the one of the first page, and those of the pages that it names."""
    reached = {html / "intro.html"}
    left = list(reached)
    while left:
        page = left.pop()
        side = read_page(page).find(class_="bd-links").find_all("a", href=True)
        listed = {(page.parent / link["href"]).resolve() for link in side if link["href"] != "#"} - reached
        left += listed
        reached |= listed
    code = {page for page in pages_of(html) if "_modules" in page.relative_to(html).parts}
    missing = {page for page in pages_of(html) if page.name not in OF_THE_BUILDER} - code - reached
    assert missing == {html / "index.html"}


def test_every_internal_link_and_anchor_resolves(html: Path) -> None:
    broken = []
    for page in pages_of(html):
        for link in read_page(page).find_all("a", href=True):
            parts = urlsplit(link["href"])
            if not is_inside(link["href"]):
                continue
            target = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            if (
                not target.is_file()
                or parts.fragment
                and target.suffix == ".html"
                and unquote(parts.fragment) not in anchors_of(target)
            ):
                broken.append((page.name, link["href"]))
    assert not broken


@pytest.mark.parametrize("file", MODULES, ids=lambda file: file.relative_to(SOURCE).as_posix())
def test_every_public_name_has_signature_docstring_and_code(html: Path, file: Path) -> None:
    parts = file.relative_to(SOURCE).with_suffix("").parts
    page, module = html.joinpath("toolbox", *parts).with_suffix(".html"), ".".join(parts)
    kinds = ast.FunctionDef | ast.ClassDef
    for member in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(member, kinds) and not member.name.startswith("_"):
            head = entries_of(page).get(f"{module}.{member.name}")
            assert head is not None, f"{page.name}: {member.name} is missing"
            assert (
                f"_modules/{'/'.join(parts)}.html#{member.name}"
                in head.select_one("a:has(.viewcode-link)")["href"]
            )
    for entry in read_page(page).select("dl.py"):
        assert entry.dd.get_text(strip=True), f"{page.name}: {entry.dt['id']} has no docstring"
    assert "np.float64(" not in read_page(page).article.get_text()


def test_every_image_exists_and_has_alt_text(html: Path) -> None:
    faults = []
    for page in pages_of(html):
        for image in read_page(page).find_all("img"):
            source = image.get("src", "")
            if not source.startswith("data:") and not (page.parent / unquote(source)).is_file():
                faults.append((page.name, source))
            if not image.get("alt", "").strip() or image["alt"].startswith(("..", "_images/")):
                faults.append((page.name, source, "no alt text"))
    assert not faults


def test_every_caption_says_simulated_or_real(profile: dict, html: Path) -> None:
    """But those of figures and tables without data, such as a diagram or a list of settings."""
    for chapter in (run.chapter for run in book_pages(profile)):
        cells = nbformat.read(NOTEBOOKS / f"{chapter}.ipynb", as_version=4).cells
        free = {c.metadata.mystnb.figure.name for c in cells if c.metadata.get("data") == "none"}
        for figure in read_page(html / "notebooks" / f"{chapter}.html").select("figure"):
            words = figure.figcaption.get_text()
            assert figure["id"] in free or re.search("simulated|real", words, re.IGNORECASE), (chapter, words)


def test_no_page_shows_an_error_or_a_missing_number(profile: dict, html: Path) -> None:
    # on the tiny profile's few scans no car drives fast, so numbers of fast scans are none there
    missing = {""} if profile["profile"] == "smoke" else {"", "nan"}
    for page in pages_of(html):
        article = read_page(page).find("article") or read_page(page)
        assert not article.select(".output.stderr, .output.traceback, .system-message, .problematic"), (
            page.name
        )
        words = article.get_text()
        assert "Traceback (most recent call last)" not in words, page.name
        assert not re.search(r"\{(glue|numref|ref|eq|cite|doc)[:}]", words), page.name
        numbers = [number.get_text().strip() for number in article.select(".pasted-text")]
        assert not missing & set(numbers), page.name


def test_no_page_needs_a_network(html: Path) -> None:
    for page in pages_of(html):
        soup = read_page(page)
        loaded = [tag.get("src", "") for tag in soup.find_all(["script", "img", "iframe", "video", "source"])]
        loaded += [
            tag["href"] for tag in soup.find_all("link", href=True) if "stylesheet" in tag.get("rel", [])
        ]
        outside = [
            address
            for address in loaded
            if address and not address.startswith("data:") and not is_inside(address)
        ]
        assert not outside, f"{page.name}: loads {outside}"
    assert (html / "_static" / "mathjax" / "tex-chtml.js").is_file()


def test_first_page_shows_the_result_and_the_three_doors(html: Path) -> None:
    article = read_page(html / "intro.html").article
    assert any("result" in image["src"] for image in article.find_all("img"))
    links = {link["href"].split("#")[0] for link in article.find_all("a", href=True)}
    assert {"notebooks/01_sessions.html", "rerun.html", "take.html"} <= links
