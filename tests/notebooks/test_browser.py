"""Check every page of the built book in Chromium: wide and light, narrow and dark, from disk, without a network.

Playwright drives the browser, axe checks contrast, names and headings, `page.js` checks the rest. Small pages with one
fault each show that every rule can fail.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, ConsoleMessage, Error, Request, sync_playwright

from print_book import OFFLINE, find_chromium

LOCAL = ("file:", "data:", "blob:", "about:")
CHECKS = Path(__file__).with_name("page.js").read_text(encoding="utf-8")
AXE = Axe().axe_script
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
BROWSERS = 2  # for the pages of a book, each in its own thread


@dataclass(frozen=True)
class View:
    """How a page is viewed: the width of the window [CSS pixels], the colour scheme, the medium."""

    width: int
    dark: bool = False
    medium: str = "screen"


WIDE, NARROW = View(1280), View(400, dark=True)


@dataclass(frozen=True)
class Visit:
    """A page in one view: its address, the view, faults as (rule, what), and what the page holds.

    ``links`` are pairs of the whole address and the attribute, ``anchors`` the names that can be linked to, ``counts``
    the numbers of equations, images and canvases; ``theme`` is "light" or "dark".
    """

    address: str
    view: View
    faults: list[tuple[str, str]]
    links: list[tuple[str, str]]
    anchors: list[str]
    theme: str
    counts: dict[str, int]


class Tab:
    """A tab that opens one page after the other and records what a page reports."""

    def __init__(self, browser: Browser) -> None:
        self.page = browser.new_page()
        self.page.add_init_script(AXE)
        self._faults: list[tuple[str, str]] = []
        self.page.on("console", self._on_console)
        self.page.on("pageerror", lambda error: self._faults.append(("console", str(error))))
        self.page.on("request", self._on_request)
        self.page.on("requestfailed", lambda it: self._faults.append(("request", f"{it.failure}: {it.url}")))

    def _on_console(self, message: ConsoleMessage) -> None:
        if message.type in ("error", "warning", "assert"):
            self._faults.append(("console", f"{message.type}: {message.text} {message.location['url']}"))

    def _on_request(self, request: Request) -> None:
        if not request.url.startswith(LOCAL):
            self._faults.append(("request", f"asks the network: {request.url}"))

    def look(self, view: View) -> None:
        """Set the size of the window, the preferred colour scheme, and the medium."""
        self.page.set_viewport_size({"width": view.width, "height": 900})
        self.page.emulate_media(color_scheme="dark" if view.dark else "light", media=view.medium)

    def open(self, address: str, view: View) -> None:
        """Load a page until its load event."""
        self._faults.clear()
        self.look(view)
        self.page.goto(address)

    def visit(self, address: str, views: Sequence[View], known: set[str] | None = None) -> list[Visit]:
        """Open a page in the first view, switch to the others without loading it again, and check it in each.

        ``known`` are combinations of colours and size whose contrast has been checked; those of this page are added.
        """
        self.open(address, views[0])
        visits, known = [], set() if known is None else known
        for view in views:
            self.look(view)
            seen = self.page.evaluate(CHECKS, list(known))
            known.update(seen.pop("kinds"))
            faults = [*self._faults, *((rule, what) for rule, what in seen.pop("faults"))]
            self._faults.clear()
            visits.append(Visit(address, view, faults, **seen))
        return visits


@contextmanager
def launch(executable: str) -> Iterator[Tab]:
    """Start a browser that resolves no name, with one tab."""
    with sync_playwright() as playwright:
        yield Tab(playwright.chromium.launch(executable_path=executable, args=[OFFLINE]))


@pytest.fixture(scope="module")
def executable() -> str:
    """The browser; without one the tests skip."""
    found = find_chromium()
    if found is None:
        pytest.skip(
            "no Chromium: install `chromium` (and `libatomic1`), or name one in the environment variable ROL_CHROMIUM"
        )
    return found


@pytest.fixture(scope="module")
def tab(executable: str) -> Iterator[Tab]:
    """One browser for the tests of this file.

    It ends with the file: until then this thread has a running event loop, in which other tests cannot start theirs.
    """
    with launch(executable) as opened:
        yield opened


@pytest.fixture
def html(profile: dict) -> Path:
    return Path(profile["book_dir"], "_build", "html").resolve()


def pages_of(html: Path) -> list[Path]:
    """List the pages, without the first, which only leads on, and the theme's files; of the pages of code only one."""
    pages = [page for page in sorted(html.rglob("*.html")) if "_static" not in page.relative_to(html).parts]
    code = [page for page in pages if "_modules" in page.relative_to(html).parts]
    return [page for page in pages if page != html / "index.html" and page not in code[1:]]


def views_of(page: Path, html: Path) -> list[View]:
    """Say how a page is looked at: one of a module, which are all made alike, in one view, the others in two."""
    folder, *below = page.relative_to(html).parts
    return [NARROW] if folder == "toolbox" and len(below) > 1 else [WIDE, NARROW]


@pytest.fixture(scope="module")
def surveys() -> dict[Path, list[Visit]]:
    """What was found on every page of a book, which is opened once for all rules."""
    return {}


@pytest.fixture(scope="module")
def known() -> set[str]:
    """Combinations of colours and size that a page of any book has had, with its fault if they have one."""
    return set()


@pytest.fixture
def visits(html: Path, executable: str, surveys: dict[Path, list[Visit]], known: set[str]) -> list[Visit]:
    if html not in surveys:
        pages = [(page.as_uri(), views_of(page, html)) for page in pages_of(html)]
        shares = [pages[k::BROWSERS] for k in range(BROWSERS)]
        with ThreadPoolExecutor(BROWSERS) as pool:
            visits = pool.map(lambda share: survey(executable, share, known), shares)
            surveys[html] = [visit for share in visits for visit in share]
    return surveys[html]


def survey(executable: str, pages: list[tuple[str, list[View]]], known: set[str]) -> list[Visit]:
    """Visit pages in a browser of their own, every second one in the opposite order of views."""
    with launch(executable) as tab:
        return [
            visit
            for k, (address, views) in enumerate(pages)
            for visit in tab.visit(address, views[:: (-1) ** k], known)
        ]


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
    assert len(visits) == sum(len(views_of(page, html)) for page in pages_of(html))
    for kind in ("equations", "images", "canvases"):
        assert sum(visit.counts[kind] for visit in visits) > 0, f"no {kind} in the whole book"


def test_every_link_leads_somewhere(visits: list[Visit]) -> None:
    assert sum(len(visit.links) for visit in visits) > len(visits)
    assert not broken_links(visits)


def test_pages_are_dark_for_whom_prefers_it(visits: list[Visit]) -> None:
    assert all(visit.theme == ("dark" if visit.view.dark else "light") for visit in visits)


def test_search_finds_pages_without_a_network(html: Path, tab: Tab) -> None:
    [search] = tab.visit((html / "search.html").as_uri() + "?q=particle", [WIDE])
    assert not search.faults
    address = tab.page.locator("#search-results a[href*='07_localization']").first.evaluate("(a) => a.href")
    [found] = tab.visit(address, [NARROW])
    assert not [what for rule, what in found.faults if rule in ("console", "request")]


def test_first_file_leads_to_the_first_page(html: Path, tab: Tab) -> None:
    tab.open((html / "index.html").as_uri(), WIDE)
    tab.page.wait_for_url((html / "intro.html").as_uri())


def test_print_is_black_on_white_and_has_no_controls(html: Path, tab: Tab) -> None:
    printed = next(page for page in pages_of(html) if "<canvas" in page.read_text(encoding="utf-8"))
    tab.open(printed.as_uri(), View(800, dark=True, medium="print"))
    assert tab.page.evaluate("document.documentElement.dataset.theme") == "dark"
    assert tab.page.evaluate("getComputedStyle(document.querySelector('article p')).color") == "rgb(0, 0, 0)"
    assert tab.page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    controls = tab.page.locator(".bd-sidebar-primary, .bd-header-article, article button, article input")
    assert controls.count() and not controls.filter(visible=True).count()
    assert tab.page.evaluate("document.documentElement.scrollWidth") <= 800


def test_claims_of_one_outcome_are_shown_by_keyboard_and_all_in_print(html: Path, tab: Tab) -> None:
    tab.open((html / "claims.html").as_uri(), WIDE)
    rows = tab.page.locator("table.claims tbody tr")
    outcomes = rows.locator(".sd-badge").all_inner_texts()
    button = tab.page.get_by_role("button", name=f"untested ({outcomes.count('untested')})")
    button.press("Enter")
    assert set(rows.filter(visible=True).locator(".sd-badge").all_inner_texts()) == {"untested"}
    assert button.get_attribute("aria-pressed") == "true"
    tab.look(View(800, medium="print"))
    assert rows.filter(visible=True).count() == len(outcomes) > 20
    assert not tab.page.locator(".claims-filter").is_visible()


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
    ("name", "<a href='#place'>here</a>", "vague"),
    ("name", "<button></button>", "button-name"),
    ("name", "<input type='text'>", "label"),
    ("heading", "<h3>Too deep</h3>", "heading-order"),
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
def test_good_page_has_no_fault(tmp_path: Path, tab: Tab, article: str) -> None:
    [visit] = tab.visit(small_page(tmp_path, article), [NARROW])
    assert not visit.faults and not broken_links([visit])


@pytest.mark.parametrize(
    ("rule", "article", "words"), BAD, ids=[f"{k}-{bad[0]}" for k, bad in enumerate(BAD)]
)
def test_rule_bites(tmp_path: Path, tab: Tab, rule: str, article: str, words: str) -> None:
    faults = tab.visit(small_page(tmp_path, article), [NARROW])[0].faults
    assert any(name == rule and words in what for name, what in faults), faults


@pytest.mark.parametrize(
    ("gone", "words"),
    [(' lang="en"', "html-has-lang"), ("A page</title>", "document-title"), ('rel="icon"', "no icon")],
)
def test_rule_of_the_page_bites(tmp_path: Path, tab: Tab, gone: str, words: str) -> None:
    page = GOOD.replace(gone, "</title>" if "title" in gone else "")
    faults = tab.visit(small_page(tmp_path, page=page), [NARROW])[0].faults
    assert any(rule == "page" and words in what for rule, what in faults), faults


@pytest.mark.parametrize("views", [(WIDE, NARROW), (NARROW, WIDE)])
def test_fault_of_one_view_is_found_there(tmp_path: Path, tab: Tab, views: tuple[View, View]) -> None:
    article = "<style>@media (prefers-color-scheme: dark) { h1 { color: #ccc } }</style><p style='width: 700px'>wide</p>"
    visits = tab.visit(small_page(tmp_path, article), views)
    assert {view: {rule for rule, _ in visit.faults} for view, visit in zip(views, visits, strict=True)} == {
        WIDE: set(),
        NARROW: {"contrast", "width"},
    }


def test_colours_that_were_checked_are_not_checked_again(tmp_path: Path, tab: Tab) -> None:
    known: set[str] = set()
    page = small_page(tmp_path, "<p style='color: #999'>pale</p>")
    assert [len(tab.visit(page, [WIDE], known)[0].faults) for _ in range(2)] == [1, 0]


def test_every_rule_is_seen_to_bite() -> None:
    assert {rule for rule, _, _ in BAD} == set(RULES)


@pytest.mark.parametrize("target", ["nowhere.html", "#nowhere", "page.html#nowhere", "dot.html?q=1"])
def test_broken_link_is_found(tmp_path: Path, tab: Tab, target: str) -> None:
    [visit] = tab.visit(small_page(tmp_path, f"<a href='{target}'>There it is</a>"), [WIDE])
    assert [line.rpartition(": ")[2] for line in broken_links([visit])] == [target]


def test_page_that_is_not_there_is_an_error(tmp_path: Path, tab: Tab) -> None:
    with pytest.raises(Error, match="nowhere"):
        tab.open((tmp_path / "nowhere.html").as_uri(), WIDE)


@pytest.mark.usefixtures(
    "executable"
)  # Playwright's driver needs one of the libraries that come with a browser
def test_browser_that_does_not_start_says_so(tmp_path: Path) -> None:
    program = tmp_path / "broken"
    program.write_text("#!/bin/sh\necho no display today\n", encoding="utf-8")
    program.chmod(0o755)
    with ThreadPoolExecutor() as pool, pytest.raises(Error, match="no display today"):
        pool.submit(survey, str(program), [], set()).result()
