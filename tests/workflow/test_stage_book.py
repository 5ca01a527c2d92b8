"""The staging of the book: its settings where the address of the repository is known, and the pages' own extension."""

import ast
import base64
import importlib.util
import itertools
import re
import shutil
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import nbformat
import pytest
import yaml
from docutils import nodes
from docutils.utils import new_document
from nbformat.v4 import new_notebook

import chapters
import stage_book
import toolbox_pages
from chapters import CHAPTERS, NOTEBOOKS, ChapterError
from toolbox_pages import module_name

ROOT = Path(__file__).resolve().parents[2]
TASKS = ROOT / "book" / "api.yml"
KNOWN = {"ROL_REPOSITORY_URL": "https://git.example.org/people/radar.git"}


@pytest.fixture
def book(tmp_path: Path) -> Path:
    (tmp_path / "_config.yml").write_text(
        (ROOT / "book/_config.yml").read_text(encoding="utf-8"), encoding="utf-8"
    )
    return tmp_path


def test_only_a_staged_book_is_removed(tmp_path: Path) -> None:
    (tmp_path / "_build" / "html").mkdir(parents=True)  # the workflow makes the folder of its output
    stage_book.clear(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["made.md"]
    (tmp_path / "intro.md").touch()
    stage_book.clear(tmp_path)
    assert not (tmp_path / "intro.md").exists()
    (tmp_path / "made.md").rename(tmp_path / "thesis.md")
    with pytest.raises(ChapterError, match="holds files but no made.md"):
        stage_book.clear(tmp_path)
    (tmp_path / "made.md").write_text("# How I made it", encoding="utf-8")
    with pytest.raises(ChapterError, match="holds files but no made.md of this program"):
        stage_book.clear(tmp_path)
    assert (tmp_path / "thesis.md").is_file()


def test_links_are_neither_removed_nor_followed(tmp_path: Path) -> None:
    staged, link = tmp_path / "staged", tmp_path / "link"
    stage_book.clear(staged)
    link.symlink_to(staged)
    with pytest.raises(ChapterError, match="link: a symbolic link"):
        stage_book.clear(link)
    (staged / "made.md").rename(tmp_path / "own.md")
    (staged / "own").symlink_to(tmp_path)
    with pytest.raises(ChapterError, match="no made.md"):
        stage_book.clear(staged)
    assert (staged / "own").is_symlink()


@pytest.fixture(scope="module")
def quiet_pages() -> ModuleType:
    spec = importlib.util.spec_from_file_location("quiet_pages", ROOT / "book/_ext/quiet_pages.py")
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "dont_write_bytecode", True)  # every file below book/ is an input of the book
        spec.loader.exec_module(module)
    return module


# ---- settings -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("environment", [{}, {"ROL_REPOSITORY_URL": ""}, {"ROL_REPOSITORY_BRANCH": "next"}])
def test_without_an_address_the_settings_stay_as_they_are(book: Path, environment: dict) -> None:
    before = (book / "_config.yml").read_text(encoding="utf-8")
    stage_book.stage_settings(book, environment)
    assert (book / "_config.yml").read_text(encoding="utf-8") == before
    assert not {"repository", "launch_buttons"} & set(yaml.safe_load(before))


def test_with_an_address_the_book_gets_a_button_for_binder(book: Path) -> None:
    before = yaml.safe_load((book / "_config.yml").read_text(encoding="utf-8"))
    stage_book.stage_settings(book, KNOWN)
    after = yaml.safe_load((book / "_config.yml").read_text(encoding="utf-8"))
    assert after == before | {
        "repository": {"url": "https://git.example.org/people/radar", "branch": "main"},
        "launch_buttons": {"notebook_interface": "jupyterlab", "binderhub_url": "https://mybinder.org"},
    }


def test_branch_and_hub_can_be_named() -> None:
    more = {"ROL_REPOSITORY_BRANCH": "next", "ROL_BINDERHUB_URL": "https://hub.example.org/"}
    settings = stage_book.launch_settings(KNOWN | more)
    assert settings["repository"]["branch"] == "next"
    assert settings["launch_buttons"]["binderhub_url"] == "https://hub.example.org"


@pytest.mark.parametrize(
    ("name", "address"),
    [
        ("ROL_REPOSITORY_URL", "git@git.example.org:people/radar.git"),
        ("ROL_REPOSITORY_URL", "../radar"),
        ("ROL_BINDERHUB_URL", "hub.example.org"),
    ],
)
def test_address_that_no_browser_opens_is_refused(name: str, address: str) -> None:
    with pytest.raises(ChapterError, match=name):
        stage_book.launch_settings(KNOWN | {name: address})


def test_staged_settings_pass_the_check_of_the_book(book: Path) -> None:
    config = pytest.importorskip("jupyter_book.config")
    stage_book.stage_settings(book, KNOWN)
    config.validate_yaml(
        yaml.safe_load((book / "_config.yml").read_text(encoding="utf-8")), raise_on_errors=True
    )


def test_binder_finds_what_the_button_needs() -> None:
    environment = yaml.safe_load((ROOT / "environment.yml").read_text(encoding="utf-8"))
    assert any(str(part).startswith("python=3.1") for part in environment["dependencies"])
    assert {"-r requirements.lock", "-e ."} <= set(environment["dependencies"][-1]["pip"])
    # With a folder of this name Binder would read that, and not the file.
    assert not (ROOT / "binder").exists() and not (ROOT / ".binder").exists()
    assert all((NOTEBOOKS / f"{chapter}.ipynb").is_file() for chapter in CHAPTERS)


# ---- files that macOS leaves ----------------------------------------------------------------------------------


def test_metadata_files_of_macos_are_passed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package, pages = tmp_path / "src/rol", tmp_path / "book"
    shutil.copytree(ROOT / "src/rol", package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "book", pages, ignore=shutil.ignore_patterns("__pycache__"))
    (pages / "api.yml").write_text("Map: {rol.maps: [load_map]}\n", encoding="utf-8")
    for folder, kind in itertools.product((package, pages, pages / "images"), ("md", "py")):
        (folder / f"._x.{kind}").write_bytes(b"\0\5\x16\7\xff")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(chapters, "SOURCE", package.parent)
    monkeypatch.setattr(toolbox_pages, "SOURCE", package.parent)
    monkeypatch.setattr(stage_book, "ROOT", tmp_path)
    for name in ("stage_notebooks", "stage_result_figure"):
        monkeypatch.setattr(stage_book, name, lambda *_: None)
    monkeypatch.setattr(stage_book, "how_made_page", lambda *_: "")
    staged = stage_book.stage(str(ROOT / "config/smoke.yaml"))
    assert (staged / "toolbox/rol/mcl.md").is_file() and (staged / "intro.md").is_file()
    assert not list(staged.rglob("._*"))
    assert chapters.stored_digest(new_notebook(), chapters.load_config(ROOT / "config/smoke.yaml"))


# ---- the toolbox ----------------------------------------------------------------------------------------------


def test_toolbox_has_a_page_for_each_package_and_module(tmp_path: Path) -> None:
    text = "### [mcl](toolbox/rol/mcl.md)\n### [bev](toolbox/rol_other/bev.md)\n"
    (tmp_path / "take.md").write_text(text, encoding="utf-8")
    shutil.copy(TASKS, tmp_path)
    entries = stage_book.stage_toolbox(tmp_path)
    pages = [page["file"] for entry in entries for page in (entry, *entry["sections"])]
    staged = {
        path.relative_to(tmp_path).with_suffix("").as_posix() for path in tmp_path.rglob("toolbox/**/*.md")
    }
    assert {*pages, "toolbox/index"} == staged and len(pages) == len(staged) - 1
    files = [file for file in chapters.SOURCE.rglob("[!.]*.py") if not file.name.startswith("__")]
    folders = {file.relative_to(chapters.SOURCE).parts[0] for file in files}
    assert len(pages) == len(files) + len(folders)
    for folder in folders:  # Sphinx gives a package without one no place to link to
        init = chapters.SOURCE / folder / "__init__.py"
        assert ast.get_docstring(ast.parse(init.read_text(encoding="utf-8"))), f"{init}: no docstring"
    page = (tmp_path / "toolbox/rol/mcl.md").read_text(encoding="utf-8")
    assert "# rol.mcl\n" in page and "File: `src/rol/mcl.py`. [Example" in page
    assert "(../../take.md#mcl)" in page
    assert ".. autofunction:: localize\n" in page and ".. autoclass:: MclSettings\n   :members:" in page
    assert "take.md" not in (tmp_path / "toolbox/rol/bev.md").read_text(encoding="utf-8")


def test_every_public_name_and_every_module_has_one_task() -> None:
    listed = [
        f"{module}.{name}" if name else module_name(file)
        for modules in yaml.safe_load(TASKS.read_text(encoding="utf-8")).values()
        for module, names in modules.items()
        for file in (
            toolbox_pages.modules_in(chapters.SOURCE / module.replace(".", "/")) if not names else [None]
        )
        for name in names or [None]
    ]
    expected = []
    for file in toolbox_pages.modules_in(chapters.SOURCE):
        name = module_name(file)
        members = toolbox_pages.public_members(file) if name.startswith("rol.") else []
        expected += [f"{name}.{member.name}" for member in members] or [name]
    assert sorted(listed) == sorted(expected)


def test_task_lists_its_functions_and_whole_modules() -> None:
    section = toolbox_pages.task_section("Map", {"rol.maps": ["load_map"], "rol_beyond.search": None})
    assert section.startswith("## Map\n")
    assert "   * - :py:obj:`maps.load_map <rol.maps.load_map>`\n     - Read a session's map.\n" in section
    assert "   * - :py:obj:`rol_beyond.search`\n     - Global localization: " in section


# ---- the pages' own extension ---------------------------------------------------------------------------------


def script(name: str | None, body: str | None = None) -> SimpleNamespace:
    return SimpleNamespace(filename=name, attributes={"body": body} if body else {})


def test_page_keeps_each_script_once_and_none_of_thebe(quiet_pages: ModuleType) -> None:
    scripts = [
        script("a.js"),
        script(None, "const THEBE_JS_URL = 1"),
        script("sphinx-thebe.js"),
        script("b.js"),
    ]
    context = {
        "script_files": [*scripts, script("a.js"), script(None, "var a"), script(None, "var a")],
        "css_files": [SimpleNamespace(filename="sphinx-thebe.css"), SimpleNamespace(filename="book.css")],
    }
    quiet_pages.leave_out_scripts(None, "intro", "page.html", context, None)
    assert [(one.filename, one.attributes.get("body")) for one in context["script_files"]] == [
        ("a.js", None),
        ("b.js", None),
        (None, "var a"),
    ]
    assert [sheet.filename for sheet in context["css_files"]] == ["book.css"]


def test_finished_pages_are_cleaned(quiet_pages: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "a.html").write_text(
        '<head>\n<link rel="preload" as="font" crossorigin href="f.woff2" />\n<link rel="stylesheet" href="a.css">\n'
        '<script src="_static/vendor/fontawesome/6.5.2/js/all.min.js?digest=1"></script>\n<script src="a.js"></script>'
        '</head><p><span class="pasted-text">-1.5</span> m or\n60 %, 3 more, 5 m/s</p><pre>2 m</pre><img alt="4 m">',
        encoding="utf-8",
    )
    twice = '<input id="search-input"><input id="search-input">'
    (tmp_path / "search.html").write_text(twice, encoding="utf-8")
    app = SimpleNamespace(outdir=tmp_path, builder=SimpleNamespace(format="html"))
    quiet_pages.clean_pages(app, None)
    assert (tmp_path / "a.html").read_text(encoding="utf-8") == (
        '<head>\n<link rel="stylesheet" href="a.css">\n<script src="a.js"></script></head><p><span class="pasted-text">'
        '−1.5</span>\xa0m or\n60\xa0%, 3 more, 5\xa0m/s</p><pre>2 m</pre><img alt="4 m">'
    )
    assert (tmp_path / "search.html").read_text(encoding="utf-8") == (
        '<input id="search-input"><input id="search-input-of-page">'
    )
    (tmp_path / "search.html").write_text(twice, encoding="utf-8")
    quiet_pages.clean_pages(app, RuntimeError("the build has failed"))
    assert (tmp_path / "search.html").read_text(encoding="utf-8") == twice


def test_parts_forget_the_document_that_they_were_parsed_in(quiet_pages: ModuleType) -> None:
    page, part, section = new_document("page"), new_document("part"), nodes.section()
    part += section
    section += nodes.paragraph("", "words")
    page.extend(part.children)
    assert page[0][0].document is part
    quiet_pages.forget_parts(None, page)
    assert all(node.document is page for node in page.findall())


def test_default_that_is_made_anew_is_shown_as_dots(quiet_pages: ModuleType) -> None:
    words = ("class", "rol.x.X", None, {})
    shown = quiet_pages.readable_defaults(None, *words, "(a: list = <factory>, b: int = 1)", "X")
    assert shown == ("(a: list = ..., b: int = 1)", "X")
    assert quiet_pages.readable_defaults(None, *words, None, None) == (None, None)


# ---- the first picture ------------------------------------------------------------------------------


def write_run(path: Path, figure: str, png: bytes | None) -> SimpleNamespace:
    outputs = (
        [nbformat.v4.new_output("display_data", {"image/png": base64.b64encode(png).decode()})] if png else []
    )
    cell = nbformat.v4.new_code_cell("", outputs=outputs, metadata={"mystnb": {"figure": {"name": figure}}})
    nbformat.write(nbformat.v4.new_notebook(cells=[cell]), path)
    return SimpleNamespace(chapter=path.stem, path=lambda out_dir: path)


@pytest.mark.parametrize(("real", "words"), [(b"real", "real.md"), (None, "simulated.md")])
def test_first_picture_is_real_where_it_can_be(
    book: Path, monkeypatch: pytest.MonkeyPatch, real: bytes | None, words: str
) -> None:
    (book / "images").mkdir()
    for name in ("real.md", "simulated.md"):
        (book / "images" / name).write_text(name, encoding="utf-8")
    pngs = {"10_real_radar": real, "07_localization": b"simulated"}
    runs = [write_run(book / f"{c}.ipynb", f, pngs[c]) for c, f, _ in stage_book.RESULT_FIGURES]
    monkeypatch.setattr(chapters, "book_pages", lambda config: runs)
    stage_book.stage_result_figure({"out_dir": ""}, book)
    assert (book / "images" / "result.png").read_bytes() == (real or b"simulated")
    assert (book / "picture.md").read_text(encoding="utf-8") == words


def test_book_without_a_first_picture_is_refused(book: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs = [write_run(book / "07_localization.ipynb", "fig-trajectory", None)]
    monkeypatch.setattr(chapters, "book_pages", lambda config: runs)
    with pytest.raises(ChapterError, match="no PNG figure named fig-trajectory"):
        stage_book.stage_result_figure({"out_dir": ""}, book)


# ---- hidden cells ---------------------------------------------------------------------------------------------


def test_hidden_cells_say_what_they_hold() -> None:
    tags = (["parameters"], ["injected-parameters"], ["hide-cell"], ["hide-input"], ["hide-cell"], [])
    cells = [nbformat.v4.new_code_cell("a = 1", metadata={"tags": tag}) for tag in tags]
    cells[3].metadata["mystnb"] = {"image": {"alt": "words"}}
    stage_book.name_folded_cells(nbformat.v4.new_notebook(cells=cells))
    shown = [cell.metadata.get("mystnb", {}).get("code_prompt_show") for cell in cells]
    words = ["parameters", "parameters of this run", "setup", "plot code", "computation"]
    assert shown == [*(f"Show {word}" for word in words), None]
    assert all("hide-input" in cell.metadata["tags"] for cell in cells[:2])
    assert cells[3].metadata["mystnb"]["image"] == {"alt": "words"}


# ---- captions -------------------------------------------------------------------------------------------------

WORDS = {"real": r"\breal\b", "simulated": r"\bsimulated\b"}


def figure_cell(caption: str, **metadata: str) -> nbformat.NotebookNode:
    """A cell with a figure that shows nothing."""
    metadata["mystnb"] = {"figure": {"name": "fig-a", "caption": caption}}
    return nbformat.v4.new_code_cell("", metadata=metadata)


@pytest.mark.parametrize(
    ("caption", "data", "completed"),
    [
        ("Errors.", "session", "Errors. Real data."),
        ("Errors ({glue:text}`kind` data).", "session", "Errors ({glue:text}`kind` data)."),
        ("Errors of real RADIATE pairs.", "real", "Errors of real RADIATE pairs."),
        ("Errors on the simulated route.", "simulated", "Errors on the simulated route."),
        ("Real and simulated.", "both", "Real and simulated."),
    ],
)
def test_only_captions_of_the_sessions_are_completed(caption: str, data: str, completed: str) -> None:
    notebook = nbformat.v4.new_notebook(cells=[figure_cell(caption, data=data)])
    stage_book.complete_captions(notebook, "Real")
    assert notebook.cells[0].metadata.mystnb.figure.caption == completed


@pytest.mark.parametrize("metadata", [{}, {"data": "virtual"}])
def test_figure_that_does_not_state_its_data_is_refused(metadata: dict) -> None:
    notebook = nbformat.v4.new_notebook(cells=[figure_cell("Errors.", **metadata)])
    with pytest.raises(
        ChapterError, match="figure fig-a: `data` .* none of session, real, simulated, both, none"
    ):
        stage_book.complete_captions(notebook, "Real")


@pytest.mark.parametrize("chapter", CHAPTERS)
def test_every_caption_names_the_data_of_its_figure(chapter: str) -> None:
    notebook = nbformat.read(NOTEBOOKS / f"{chapter}.ipynb", as_version=4)
    stage_book.complete_captions(notebook, "Simulated")
    for cell in notebook.cells:
        figure = cell.metadata.get("mystnb", {}).get("figure", {})
        if "caption" in figure:
            data, caption = cell.metadata["data"], figure["caption"]
            is_said = {name: bool(re.search(word, caption, re.IGNORECASE)) for name, word in WORDS.items()}
            if data == "session":
                assert (stage_book.GLUED_KIND in caption) != caption.endswith(" Simulated data."), caption
            elif data != "none":
                is_said["simulated"] |= stage_book.GLUED_KIND in caption
                assert all(is_said.values()) if data == "both" else is_said[data], caption
                assert not caption.endswith((" Simulated data.", " Real data.")), caption
