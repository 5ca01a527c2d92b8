"""Print the built book of a profile into one PDF, as `make pdf` does.

python workflow/print_book.py config/demo.yaml

Headless Chromium prints the pages in the order of the table of contents, without the pages of single modules.
"""

from __future__ import annotations

import io
import os
import shutil
import sys
from pathlib import Path

import yaml
from playwright.sync_api import Error, sync_playwright
from pypdf import PdfReader, PdfWriter
from pypdf.generic import NameObject, TextStringObject

from chapters import ChapterError, load_config
from rol.files import read_text, write_bytes

NAMES = ("chromium", "chromium-browser", "google-chrome")
OFFLINE = "--host-resolver-rules=MAP * ~NOTFOUND"  # no name is resolved, so nothing leaves the machine
WIDTH_PX = 907  # of the text, 180 mm, at the scale of the print
PAPER = {"format": "A4", "scale": 0.75, "print_background": True, "outline": True, "tagged": True}
MARGIN = {"top": "16mm", "bottom": "18mm", "left": "15mm", "right": "15mm"}
NUMBER = '<p style="break-after: page; margin: 0; padding-top: 375mm; text-align: center">{}</p>'


def find_chromium() -> str | None:
    """Return the path of the browser: the environment's ``ROL_CHROMIUM``, else the first of the usual names."""
    named = os.environ.get("ROL_CHROMIUM")
    return next(filter(None, map(shutil.which, [named] if named else NAMES)), None)


def print_pages(addresses: list[str], executable: str) -> bytes:
    """Print pages one after the other into one PDF, numbered, with links between them."""
    writer, pdf, prepare = PdfWriter(), io.BytesIO(), read_text(Path(__file__).with_suffix(".js"))
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, args=[OFFLINE])
        page = browser.new_page(viewport={"width": WIDTH_PX, "height": 1200}, color_scheme="light")
        page.emulate_media(media="print")
        for address in addresses:
            page.goto(address)
            page.evaluate(prepare, addresses)
            writer.append(io.BytesIO(page.pdf(margin=MARGIN, **PAPER)))
        page.set_content("".join(NUMBER.format(number + 1) for number in range(len(writer.pages))))
        numbers = PdfReader(io.BytesIO(page.pdf(**PAPER)))
    for printed, number in zip(writer.pages, numbers.pages, strict=False):
        printed.merge_page(number)
        for link in (annotation.get_object() for annotation in printed.get("/Annots", [])):
            address, _, place = link.get("/A", {}).get("/URI", "").partition("#")
            if address in addresses:  # a place on another page
                del link["/A"]
                link[NameObject("/Dest")] = TextStringObject(f"/{place}")
    writer.write(pdf)
    return pdf.getvalue()


def main(config_path: str) -> Path:
    """Write the PDF of a profile's book and return its path."""
    config, executable = load_config(config_path), find_chromium()
    html = Path(config["book_dir"], "_build", "html").resolve()
    if not (html / "index.html").is_file():
        raise ChapterError(f"{html}: no book here; run `make book PROFILE={config['profile']}`")
    if not executable:
        raise ChapterError("no Chromium: install `chromium`, or set ROL_CHROMIUM to its path")
    contents = yaml.safe_load(read_text(html.parents[1] / "_toc.yml"))
    listed = [contents["root"], *(entry["file"] for part in contents["parts"] for entry in part["chapters"])]
    pdf = print_pages([(html / f"{name}.html").as_uri() for name in listed], executable)
    write_bytes(target := Path(config["out_dir"], "radar_on_lidar.pdf"), pdf)
    return target


if __name__ == "__main__":
    try:
        print(f"printed: {main(sys.argv[1])}")
    except (ChapterError, Error) as error:
        sys.exit(f"ERROR: {error}")
