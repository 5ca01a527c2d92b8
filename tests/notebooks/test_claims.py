"""Pages on claims and choices: each block is complete and names its evidence, and the tables agree with the blocks."""

import re
from dataclasses import dataclass
from pathlib import Path

import pytest

from chapters import CHAPTERS

BOOK = Path(__file__).resolve().parents[2] / "book"
# Outcome -> colour of its badge.
OUTCOMES = {
    "supported": "success",
    "conditional": "warning",
    "not supported": "danger",
    "untested": "info",
    "erratum or not empirical": "secondary",
}
OURS, TEXT = "ABCD", "T"  # evidence that was computed, and that of the paper's text alone
# What the paper has: sections, and the last of its equations, figures and tables.
PLACE = re.compile(r"Abstract|Sec\. (I|II|III-[AB]|IV-[ABC]|V)\b|Eq\. [1-9]\b|Fig\. [1-4]\b|Table I{1,3}\b")
BLOCK = re.compile(r"^\((claim-[\w-]+)\)=\n### (\d+)\. (.+)\n", re.MULTILINE)
BADGE = r"\{bdg-(\w+)-line\}`([^`]+)`"
CONCLUSION = r"^(?:[A-Z].+[.] )?Chapters? \[.+\)\.$"
LINK = re.compile(r"\[[^\]]*\]\([^)]*\)")
GLUED = re.compile(r"\{glue:text\}`notebooks/(\w+)\.ipynb::[\w-]+:[^`]+`")
# Digits that a line of ours may contain besides glued ones: names, and limits.
NAMES_AND_LIMITS = re.compile(
    r"\{glue:text\}`[^`]+`|`[^`]*`|\{cite\}`[^`]+`|Seq0\d|Eq\. \d|\bL1\b|\bAt 35 %|pix2pix|\b[23]D\b"
    r"|\b(Within|within|more than|More than|over|distance of|of starts) \d+( and \d+)? m( and \d+ deg)?\b"
)


@dataclass(frozen=True)
class Claim:
    """One block of the page."""

    label: str
    number: int
    title: str
    text: str

    @property
    def head(self) -> tuple[str, str, str]:
        """Colour, outcome and place; empty where there is not exactly one such line."""
        found = re.findall(rf"^{BADGE} \*\*Paper\*\* \((.+?)\)(?:: .+|\.)$", self.text, re.MULTILINE)
        return found[0] if len(found) == 1 else ("", "", "")

    @property
    def evidence(self) -> list[tuple[str, str, str]]:
        """Letter, number of cases and finding of each line."""
        return re.findall(r"^- \*\*([^*]+)\*\*(?: \(([^)]+)\))?: (.+)$", self.text, re.MULTILINE)

    @property
    def conclusion(self) -> str:
        """Last line: what remains, if anything, and the chapters."""
        found = re.findall(CONCLUSION, self.text, re.MULTILINE)
        return found[0] if len(found) == 1 else ""


def read_page(name: str) -> str:
    return (BOOK / name).read_text(encoding="utf-8")


def read_claims() -> list[Claim]:
    page = read_page("claims.md")
    starts = list(BLOCK.finditer(page))
    ends = [match.start() for match in starts[1:]] + [len(page)]
    return [
        Claim(match[1], int(match[2]), match[3], page[match.end() : end])
        for match, end in zip(starts, ends, strict=True)
    ]


CLAIMS = read_claims()
each_claim = pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.label)


def test_claims_are_numbered_and_each_has_a_label() -> None:
    assert 20 <= len(CLAIMS) <= 35
    assert [claim.number for claim in CLAIMS] == list(range(1, len(CLAIMS) + 1))
    assert len({claim.label for claim in CLAIMS}) == len(CLAIMS)
    headings = re.findall(r"^### ", read_page("claims.md"), re.MULTILINE)
    assert len(headings) == len(CLAIMS), "a block without its label"


@each_claim
def test_a_claim_has_an_outcome_and_its_place_in_the_paper(claim: Claim) -> None:
    colour, outcome, place = claim.head
    assert OUTCOMES.get(outcome) == colour
    for part in place.split("; "):
        assert PLACE.match(part), f"no place of the paper: {part}"


@each_claim
def test_evidence_has_its_letter_and_number_of_cases(claim: Claim) -> None:
    letters = [letter for letter, _, _ in claim.evidence]
    assert letters and letters == sorted(letters)
    for letter, cases, finding in claim.evidence:
        assert letter in OURS + TEXT
        assert (letter == TEXT) == (not cases), f"{letter}: {cases or 'no number of cases'}"
        assert letter == TEXT or GLUED.search(finding) or LINK.search(finding), finding


@each_claim
def test_simulation_alone_supports_no_claim(claim: Claim) -> None:
    letters = {letter for letter, _, _ in claim.evidence}
    assert claim.head[1] != "supported" or letters - {"D"}


@each_claim
def test_a_conclusion_leads_to_a_chapter(claim: Claim) -> None:
    chapters = set(re.findall(r"\]\(notebooks/(\w+)\.ipynb\)", claim.conclusion))
    assert chapters and chapters <= set(CHAPTERS)


@each_claim
def test_no_number_of_ours_is_typed(claim: Claim) -> None:
    lines = [finding for letter, _, finding in claim.evidence if letter in OURS] + [claim.conclusion]
    typed = [line for line in lines if re.search(r"\d", NAMES_AND_LIMITS.sub("", LINK.sub("", line)))]
    assert not typed


@each_claim
def test_a_block_contains_nothing_but_its_parts(claim: Claim) -> None:
    """A line that is neither would escape the rules above; a heading of the next group may follow."""
    for line in claim.text.strip().splitlines():
        assert not line or re.match(rf"\{{bdg-|{CONCLUSION}|- \*\*[A-Z]\*\*|## ", line), line


def test_the_table_agrees_with_the_blocks() -> None:
    pattern = rf"^\| \[(\d+)\]\((claim-[\w-]+)\) \| (.+?) \| {BADGE} \| (.+?) \| (.+) \|$"
    rows = re.findall(pattern, read_page("claims.md"), re.MULTILINE)
    assert [(int(row[0]), *row[1:5]) for row in rows] == [
        (claim.number, claim.label, claim.title, *claim.head[:2]) for claim in CLAIMS
    ]
    for row, claim in zip(rows, CLAIMS, strict=True):
        kinds = [kind.partition("&nbsp;") for kind in row[5].split("; ")]
        assert [letter for letter, _, _ in kinds] == [letter for letter, _, _ in claim.evidence]
        for (_, _, cases), (_, told, _) in zip(kinds, claim.evidence, strict=True):
            assert [m[0] for m in GLUED.finditer(cases)] == [m[0] for m in GLUED.finditer(told)], claim.label
        assert 0 < len(row[6].split()) <= 16, f"reason of {claim.label}"


def test_the_counts_on_top_agree_with_the_blocks() -> None:
    words = r"Of (\d+) claims, \*\*(\d+)\*\* are supported" + "".join(
        rf",(?: and)? \*\*(\d+)\*\* {outcome}" for outcome in list(OUTCOMES)[1:]
    )
    counted = re.search(words, read_page("claims.md"))
    outcomes = [claim.head[1] for claim in CLAIMS]
    assert counted
    assert [int(n) for n in counted.groups()] == [len(CLAIMS), *(outcomes.count(name) for name in OUTCOMES)]


def test_links_to_a_claim_have_its_number() -> None:
    numbers = {claim.label: claim.number for claim in CLAIMS}
    pages = read_page("claims.md") + read_page("choices.md")
    for number, label in re.findall(r"\[claim (\d+)\]\((claim-[\w-]+)\)", pages):
        assert numbers.get(label) == int(number), label
    assert set(re.findall(r"\]\((claim-[\w-]+)\)", pages)) <= set(numbers)


def test_every_choice_has_a_reason_and_an_effect() -> None:
    """The effect is a number of a chapter with its evidence, a page that shows it, or a dash."""
    rows = re.findall(
        r"^\| \[\d+\]\(notebooks/\w+\.ipynb\) \| (.+) \|$", read_page("choices.md"), re.MULTILINE
    )
    assert len(rows) > 35
    for row in rows:
        cells = row.split(" | ")
        assert len(cells) == 4 and all(cells), row
        if GLUED.search(cells[3]):
            assert re.search(r"\([A-D]\b", cells[3]), f"no evidence: {row}"
        else:
            assert re.search(r"^–$|\]\(notebooks/", cells[3]), row


@pytest.mark.parametrize("page", ["claims.md", "choices.md", "intro.md"])
def test_numbers_come_from_chapters_that_exist(page: str) -> None:
    roles = re.findall(r"\{glue:text\}`[^`]*`", read_page(page))
    assert roles and all(GLUED.fullmatch(role) for role in roles)
    assert {GLUED.fullmatch(role)[1] for role in roles} <= set(CHAPTERS)
