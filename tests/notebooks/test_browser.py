"""Every page of the built book in a real browser, opened from disk: wide and light, narrow and dark, without a network.

The rules are checked by `page.js` in the page and by `browser.py` from what the browser reports. That each of them can
fail is seen on small pages with one fault each.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from browser import Browser, BrowserError, View, Visit, find_chromium

from chapters import CHAPTERS

WIDE, NARROW = View(1280), View(400, dark=True)
RULES = {
    "console": "no error and no warning",
    "request": "every file is there, and nothing is asked of a network",
    "page": "a language, a title, an icon, every id once",
    "equation": "every equation is typeset, no TeX is left",
    "markup": "no Markdown is left",
    "font": "every font is loaded",
    "image": "every picture is loaded and has words",
    "animation": "has controls, plays, below 3 MB",
    "name": "links, buttons and fields say what they are",
    "heading": "one title, no level left out",
    "table": "has a header",
    "width": "nothing is wider than the window",
    "contrast": "text stands out from its ground, 4.5 to 1, large text 3 to 1",
}
TABS = 2
FIRST_SCREEN_PX = 800  # height of the window of a small laptop
NEED_REAL_DATA = ("09_oxford_route", "10_real_radar")  # without it they have no picture


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """A browser for all tests of this file; without one they skip."""
    executable = find_chromium()
    if executable is None:
        pytest.skip("no Chromium: install `chromium`, or name one in the environment variable ROL_CHROMIUM")
    browser = Browser(executable, tmp_path_factory.mktemp("chromium"))
    yield browser
    browser.close()


@pytest.fixture
def html(profile: dict) -> Path:
    return Path(profile["book_dir"], "_build", "html").resolve()


def pages_of(html: Path) -> list[Path]:
    """List the pages, without the first, which only leads on, and without the theme's own files."""
    pages = [page for page in sorted(html.rglob("*.html")) if "_static" not in page.relative_to(html).parts]
    return [page for page in pages if page != html / "index.html"]


@pytest.fixture(scope="module")
def surveys() -> dict[Path, list[Visit]]:
    """What was found on every page of a book, which is opened once for all rules."""
    return {}


@pytest.fixture
def visits(html: Path, chromium: Browser, surveys: dict[Path, list[Visit]]) -> list[Visit]:
    if html not in surveys:
        addresses, tabs = [page.as_uri() for page in pages_of(html)], [chromium.tab() for _ in range(TABS)]
        with ThreadPoolExecutor(TABS) as pool:
            shares = pool.map(survey, tabs, [addresses[k::TABS] for k in range(TABS)])
            surveys[html] = [visit for share in shares for visit in share]
    return surveys[html]


def survey(tab: object, addresses: list[str]) -> list[Visit]:
    return [tab.visit(address, view) for address in addresses for view in (WIDE, NARROW)]


def told(visit: Visit) -> str:
    return f"{'/'.join(urlsplit(visit.address).path.split('/')[-2:])} at {visit.view.width} px"


def broken_links(visits: list[Visit]) -> list[str]:
    """List the links within the book, as scripts have left them, that lead nowhere."""
    anchors: dict[str, set[str]] = {}
    for visit in visits:
        anchors.setdefault(visit.address, set()).update(visit.anchors)
    broken = []
    for visit in visits:
        for whole, said in visit.links:
            address, _, name = whole.partition("#")
            if not address.startswith("file:"):
                continue
            there = Path(unquote(urlsplit(address).path)).is_file()
            page = address.partition("?")[0]
            if not there or name and page in anchors and unquote(name) not in anchors[page]:
                broken.append(f"{told(visit)}: {said}")
    return broken


# ---- the book -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rule", RULES)
def test_every_page_keeps_the_rule(visits: list[Visit], rule: str) -> None:
    faults = [f"{told(visit)}: {what}" for visit in visits for name, what in visit.faults if name == rule]
    assert not faults, f"{rule} ({RULES[rule]}):\n" + "\n".join(faults)


def test_no_page_has_a_fault_of_another_kind(visits: list[Visit]) -> None:
    assert {rule for visit in visits for rule, _ in visit.faults} <= set(RULES)


def test_every_page_was_seen_with_what_it_holds(html: Path, visits: list[Visit]) -> None:
    assert len(visits) == 2 * len(pages_of(html))
    for kind in ("equations", "images", "canvases"):
        assert sum(visit.counts[kind] for visit in visits) > 0, f"no {kind} in the whole book"


def test_chapters_have_a_picture_on_the_first_screen(visits: list[Visit]) -> None:
    chapters = [
        v for v in visits if "/notebooks/" in v.address and (v.picture is not None or not needs_real(v))
    ]
    assert len(chapters) >= 2 * (len(CHAPTERS) - len(NEED_REAL_DATA))
    late = [f"{told(v)}: ends at {v.picture} px" for v in chapters if (v.picture or 1e9) > FIRST_SCREEN_PX]
    assert not late, "\n".join(late)


def needs_real(visit: Visit) -> bool:
    return any(chapter in visit.address for chapter in NEED_REAL_DATA)


def test_every_link_leads_somewhere(visits: list[Visit]) -> None:
    assert sum(len(visit.links) for visit in visits) > len(visits)
    assert not broken_links(visits)


def test_pages_are_dark_for_whom_prefers_it(visits: list[Visit]) -> None:
    assert all(visit.theme == ("dark" if visit.view.dark else "light") for visit in visits)


def test_search_finds_pages_without_a_network(html: Path, chromium: Browser) -> None:
    tab = chromium.tab()
    visit = tab.visit((html / "search.html").as_uri() + "?q=particle", WIDE)
    assert not visit.faults
    found = tab.run("""new Promise((done) => {
        const look = (left) => {
            const names = [...document.querySelectorAll("#search-results li a")].map((link) => link.href);
            const isListed = names.some((name) => name.includes("07_localization"));
            if (isListed || !left) done(names); else setTimeout(look, 100, left - 1);
        };
        look(100);
    })""")
    assert any("07_localization" in address for address in found), found
    assert not [words for words in tab.visit(found[0], NARROW).faults if words[0] in ("console", "request")]


def test_first_file_leads_to_the_first_page(html: Path, chromium: Browser) -> None:
    tab = chromium.tab()
    tab.open((html / "index.html").as_uri(), WIDE)
    tab.wait_for("Page.loadEventFired", times=2)
    assert tab.run("location.href") == (html / "intro.html").as_uri()


def test_print_is_black_on_white_and_has_no_controls(html: Path, chromium: Browser) -> None:
    tab = chromium.tab()
    page = next(page for page in pages_of(html) if "<canvas" in page.read_text(encoding="utf-8"))
    tab.open(page.as_uri(), View(800, dark=True, medium="print"))
    assert tab.run("document.documentElement.dataset.theme") == "dark"
    assert tab.run("getComputedStyle(document.querySelector('article p')).color") == "rgb(0, 0, 0)"
    assert tab.run("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    controls = ".bd-sidebar-primary, .bd-header-article, article button, article input"
    shown = f"[...document.querySelectorAll('{controls}')].filter((e) => e.checkVisibility()).length"
    assert tab.run(shown) == 0
    assert tab.run("document.documentElement.scrollWidth") <= 800


# ---- the checker ----------------------------------------------------------------------------------------------

DOT = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
)
GOOD = """<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>A page</title>
<link rel="icon" href="data:,"></head><body><article>
<h1>A page</h1><p id="place">Words and <a href="#place">a place</a>.</p>
<img src="dot.png" alt="A dot"><table><tr><th>one</th></tr><tr><td>1</td></tr></table>
</article></body></html>"""
PLAYER = (
    '<div><canvas width="9" height="9" role="img" aria-label="A film"></canvas>'
    '<button aria-label="play" onclick="{}">&gt;</button><input type="range" value="0" max="9" aria-label="time"></div>'
)
PLAYS = PLAYER.format("this.nextElementSibling.value = +this.nextElementSibling.value + 1")
# rule, what is put at the end of the article, words of the fault
BAD = [
    ("console", "<script>throw new Error('broken script')</script>", "broken script"),
    ("console", "<script>setTimeout(() => nobody.calls(), 0)</script>", "nobody is not defined"),
    ("console", "<script>console.error('a complaint')</script>", "a complaint"),
    ("console", "<script>console.warn('a warning')</script>", "a warning"),
    ("request", "<script src='nowhere.js'></script>", "nowhere.js"),
    ("request", "<script src='https://example.org/a.js'></script>", "asks the network"),
    ("request", "<script>fetch('http://example.org/b').catch(() => 0)</script>", "asks the network"),
    ("request", "<link rel='stylesheet' href='nowhere.css'>", "nowhere.css"),
    ("page", "<p id='place'>again</p>", "id place twice"),
    ("equation", "<p>With $x^2$ left.</p>", "raw TeX"),
    ("equation", r"<p>\(y\) is left</p>", "raw TeX"),
    ("equation", r"<p>The \alpha is left</p>", "raw TeX"),
    ("equation", r"<span class='math'>x</span>", "not typeset"),
    ("equation", "<mjx-container><mjx-merror>Undefined</mjx-merror></mjx-container>", "Undefined"),
    ("markup", "<p>a `word` of code</p>", "raw Markdown"),
    ("font", "<span class='math'><mjx-container>x</mjx-container></span>", "no font of MathJax"),
    (
        "font",
        "<style>@font-face { font-family: F; src: url(dot.png) } p { font-family: F }</style>",
        "F did not load",
    ),
    ("image", "<img src='nowhere.png' alt='Nothing'>", "not loaded"),
    ("image", "<img src='dot.png'>", "no alt text"),
    ("image", "<img src='dot.png' alt=' '>", "no alt text"),
    ("image", PLAYS.replace(' aria-label="A film"', ""), "no words"),
    ("animation", "<video src='dot.png' aria-label='A film'></video>", "no controls"),
    ("animation", "<img src='film.gif' alt='A film'>", "a gif has no controls"),
    ("animation", "<canvas aria-label='A film'></canvas>", "no button or no slider"),
    ("animation", PLAYER.format(""), "does not play"),
    ("animation", PLAYS.replace("<button", "<button tabindex='-1'"), "keyboard"),
    ("animation", PLAYS.replace("</div>", f"<p hidden>{'a ' * 1_500_000}</p></div>"), "bytes"),
    ("name", "<a href='#place'>here</a>", "says nothing"),
    ("name", "<button></button>", "no name"),
    ("name", "<input type='text'>", "no label"),
    ("heading", "<h3>Too deep</h3>", "h3 after h1"),
    ("heading", "<h1>Another</h1>", "2 headings of the first level"),
    ("table", "<table><tr><td>1</td></tr></table>", "no header"),
    ("width", "<div style='width: 1500px'>wide</div>", "reaches to 1508 px"),
    (
        "width",
        "<div style='overflow: hidden'><p style='width: 1500px'>cut off</p></div>",
        "reaches to 1508 px",
    ),
    ("contrast", "<p style='color: #999'>pale</p>", "pale"),
    ("contrast", "<div style='background: #222'><p style='color: #555'>dim</p></div>", "dim"),
]


def small_page(folder: Path, article: str = "", page: str = GOOD) -> str:
    (folder / "dot.png").write_bytes(DOT)
    (folder / "page.html").write_text(page.replace("</article>", f"{article}</article>"), encoding="utf-8")
    return (folder / "page.html").as_uri()


@pytest.mark.parametrize(
    "article", ["", PLAYS, "<div style='overflow: auto'><p style='width: 1500px'>wide</p></div>"]
)
def test_good_page_has_no_fault(tmp_path: Path, chromium: Browser, article: str) -> None:
    visit = chromium.shared_tab().visit(small_page(tmp_path, article), NARROW)
    assert not visit.faults and not broken_links([visit])


@pytest.mark.parametrize(
    ("rule", "article", "words"), BAD, ids=[f"{k}-{bad[0]}" for k, bad in enumerate(BAD)]
)
def test_rule_bites(tmp_path: Path, chromium: Browser, rule: str, article: str, words: str) -> None:
    faults = chromium.shared_tab().visit(small_page(tmp_path, article), NARROW).faults
    assert any(name == rule and words in what for name, what in faults), faults


@pytest.mark.parametrize(("before", "ends"), [("", 0), ("<div style='height: 2000px'>words</div>", 2000)])
def test_place_of_the_first_picture_is_told(
    tmp_path: Path, chromium: Browser, before: str, ends: int
) -> None:
    picture = "<img src='dot.png' alt='A dot' style='display: block; height: 300px'>"
    visit = chromium.shared_tab().visit(small_page(tmp_path, before + picture), WIDE)
    assert ends + 300 < visit.picture < ends + 500
    assert chromium.shared_tab().visit(small_page(tmp_path), WIDE).picture is None  # a dot is no picture


@pytest.mark.parametrize(
    ("gone", "words"),
    [(' lang="en"', "no language"), ("A page</title>", "no title"), ('rel="icon"', "no icon")],
)
def test_rule_of_the_page_bites(tmp_path: Path, chromium: Browser, gone: str, words: str) -> None:
    page = GOOD.replace(gone, "</title>" if "title" in gone else "")
    visit = chromium.shared_tab().visit(small_page(tmp_path, page=page), NARROW)
    assert ("page", words) in visit.faults


def test_every_rule_is_seen_to_bite() -> None:
    assert {rule for rule, _, _ in BAD} == set(RULES)


@pytest.mark.parametrize("target", ["nowhere.html", "#nowhere", "page.html#nowhere", "dot.html?q=1"])
def test_broken_link_is_found(tmp_path: Path, chromium: Browser, target: str) -> None:
    visit = chromium.shared_tab().visit(small_page(tmp_path, f"<a href='{target}'>There it is</a>"), WIDE)
    assert [line.rpartition(": ")[2] for line in broken_links([visit])] == [target]


def test_page_that_is_not_there_is_an_error(tmp_path: Path, chromium: Browser) -> None:
    with pytest.raises(BrowserError, match="nowhere"):
        chromium.shared_tab().open((tmp_path / "nowhere.html").as_uri(), WIDE)


def test_browser_that_does_not_start_says_so(tmp_path: Path) -> None:
    program = tmp_path / "broken"
    program.write_text("#!/bin/sh\necho no display today\n", encoding="utf-8")
    program.chmod(0o755)
    with pytest.raises(BrowserError, match="no display today"):
        Browser(str(program), tmp_path)


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
