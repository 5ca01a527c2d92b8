"""The PDF of the whole book: order, numbers, outline, links, and what stops it."""

from pathlib import Path

import pytest
import yaml
from playwright.sync_api import Error
from pypdf import PdfReader

import print_book
from chapters import ChapterError
from print_book import find_chromium

ROOT = Path(__file__).resolve().parents[2]
PAGE = """<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{title}</title></head><body>
<article><h1>{title}</h1>{text}</article></body></html>"""
PAGES = {
    "intro": """<p><a href="part/one.html#place">there</a> <a href="toolbox/rol.html">code</a> <a href="#place">here</a>
        <a href="https://example.org/">elsewhere</a></p>
        <details><summary>Show plot code</summary><p>hidden words</p></details>
        <p id="place">first place</p>""",
    "part/one": """<div style="height: 2000px">A high box</div><h2 id="place">Second place</h2>
        <table><tr>{}</tr></table>""".format("<td style='min-width: 200px'>cell</td>" * 8 + "<td>last</td>"),
    "toolbox/index": "<p>All functions</p>",
    "toolbox/rol": "<p>A page of one module</p>",
}


@pytest.fixture
def profile(tmp_path: Path) -> Path:
    """A profile with a small built book, whose folder has a name that links must encode."""
    book = tmp_path / "Käse Ordner" / "book"
    for name, text in PAGES.items():
        page = book / "_build" / "html" / f"{name}.html"
        page.parent.mkdir(parents=True, exist_ok=True)
        page.write_text(PAGE.format(title=f"Page {name}", text=text), encoding="utf-8")
    (book / "_build/html/index.html").touch()
    toolbox = {"file": "toolbox/index", "sections": [{"file": "toolbox/rol"}]}
    contents = {"root": "intro", "parts": [{"chapters": [{"file": "part/one"}]}, {"chapters": [toolbox]}]}
    (book / "_toc.yml").write_text(yaml.safe_dump(contents), encoding="utf-8")
    config = yaml.safe_load((ROOT / "config/smoke.yaml").read_text(encoding="utf-8"))
    config |= {"out_dir": str(tmp_path / "out"), "book_dir": str(book)}
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
    return tmp_path / "tiny.yaml"


def page_of(reader: PdfReader, link: dict) -> int:
    """Give the number of the page to which a link within the PDF leads."""
    return reader.get_destination_page_number(reader.named_destinations[link["/Dest"]])


@pytest.mark.skipif(find_chromium() is None, reason="no Chromium")
def test_pages_are_merged_in_order_with_numbers_outline_and_links(profile: Path) -> None:
    pdf = print_book.main(str(profile))
    assert pdf == profile.parent / "out" / "radar_on_lidar.pdf"
    reader = PdfReader(pdf)
    texts = [page.extract_text() for page in reader.pages]
    titles = [
        k
        for name in ("intro", "part/one", "toolbox/index")
        for k, text in enumerate(texts)
        if f"Page {name}" in text
    ]
    assert titles[0] == 0 and titles == sorted(titles) and len(set(titles)) == 3
    assert len(texts) > 3 and all(text.split()[-1] == str(k + 1) for k, text in enumerate(texts))
    assert not any("hidden words" in text or "one module" in text for text in texts)
    assert any("last" in text for text in texts)  # a table wider than the paper is shrunk
    outline = [entry.title for entry in reader.outline if not isinstance(entry, list)]
    assert outline == ["Page intro", "Page part/one", "Page toolbox/index"]
    links = [link.get_object() for link in reader.pages[0]["/Annots"]]
    to_section, to_place, elsewhere = (link for link in links if "/Dest" in link or "/A" in link)
    [section] = [k for k, text in enumerate(texts) if "Second place" in text]
    assert page_of(reader, to_section) == section > titles[1] and page_of(reader, to_place) == 0
    assert elsewhere["/A"]["/URI"] == "https://example.org/"
    assert b"file:" not in pdf.read_bytes()


@pytest.mark.skipif(find_chromium() is None, reason="no Chromium")
def test_nothing_is_written_if_a_page_is_missing(profile: Path) -> None:
    (profile.parent / "Käse Ordner/book/_build/html/part/one.html").unlink()
    with pytest.raises(Error, match="one.html"):
        print_book.main(str(profile))
    assert not (profile.parent / "out").exists()


def test_missing_book_and_missing_browser_are_named(
    profile: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROL_CHROMIUM", str(tmp_path / "gone"))
    with pytest.raises(ChapterError, match="no Chromium: install `chromium`, or set ROL_CHROMIUM"):
        print_book.main(str(profile))
    (tmp_path / "Käse Ordner/book/_build/html/index.html").unlink()
    with pytest.raises(ChapterError, match="no book here; run `make book PROFILE=smoke`"):
        print_book.main(str(profile))


def test_browser_is_found_by_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "google-chrome"
    program.write_text("#!/bin/sh\n", encoding="utf-8")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("ROL_CHROMIUM", raising=False)
    assert find_chromium() == str(program)
    monkeypatch.setenv("ROL_CHROMIUM", str(tmp_path / "gone"))
    assert find_chromium() is None
    monkeypatch.setenv("PATH", str(tmp_path / "empty"))
    monkeypatch.delenv("ROL_CHROMIUM")
    assert find_chromium() is None
