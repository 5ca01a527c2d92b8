"""The ledger of claims: every block is whole, says where its numbers come from, and agrees with the table on top."""

import re
from dataclasses import dataclass
from pathlib import Path

import pytest

from chapters import CHAPTERS

BOOK = Path(__file__).resolve().parents[2] / "book"
# Verdict in a block -> its word in the table on top.
VERDICTS = {
    "reproduced": "reproduced",
    "reproduced in part": "in part",
    "contradicted": "contradicted",
    "cannot be tested without the data set": "cannot be tested",
}
COLOURS = {
    "reproduced": "success",
    "in part": "warning",
    "contradicted": "danger",
    "cannot be tested": "info",
}
OURS = ("Simulated", "Real route", "Real scans", "Times")  # lines whose numbers were computed
MARKS = (*OURS, "The paper itself")
# What the paper has: sections, and the last of its equations, figures and tables.
PLACE = re.compile(r"Abstract|Sec\. (I|II|III-[AB]|IV-[ABC]|V)\b|Eq\. [1-9]\b|Fig\. [1-4]\b|Table I{1,3}\b")
BLOCK = re.compile(r"^\((claim-[\w-]+)\)=\n### (\d+)\. (.+)\n", re.MULTILINE)
LINK = re.compile(r"\[[^\]]*\]\([^)]*\)")
# Digits that a line of ours may hold besides glued ones: names, and limits that say what is counted.
NAMES_AND_LIMITS = re.compile(
    r"\{glue:text\}`[^`]+`|`[^`]*`|\{cite\}`[^`]+`|Seq0\d|Eq\. \d|L1\b|pix2pix|\b[23]D\b|chapter \d+"
    r"|\b(within|beyond) \d+ m( and \d+ (deg|m))?\b"
)


@dataclass(frozen=True)
class Claim:
    """One block of the ledger."""

    label: str
    number: int
    title: str
    text: str

    @property
    def place(self) -> str:
        found = re.findall(r"^\*\*Paper\*\* \((.+?)\): ", self.text, re.MULTILINE)
        return found[0] if len(found) == 1 else ""

    @property
    def lines(self) -> list[tuple[str, str]]:
        return re.findall(r"^- \*\*([^*]+)\*\*: (.+)$", self.text, re.MULTILINE)

    @property
    def verdict(self) -> tuple[str, str, str]:
        """Colour, words and what is said to it; empty where there is not exactly one verdict."""
        found = re.findall(
            r"^\*\*Verdict\*\*: \{bdg-(\w+)-line\}`([^`]+)`(?: (.+))?$", self.text, re.MULTILINE
        )
        return found[0] if len(found) == 1 else ("", "", "")

    @property
    def chapters(self) -> set[str]:
        """Chapters that the verdict sends the reader to."""
        return set(re.findall(r"\]\(notebooks/(\w+)\.ipynb\)", self.verdict[2]))


def read_ledger() -> str:
    return (BOOK / "claims.md").read_text(encoding="utf-8")


def read_claims() -> list[Claim]:
    ledger = read_ledger()
    starts = list(BLOCK.finditer(ledger))
    ends = [match.start() for match in starts[1:]] + [len(ledger)]
    return [
        Claim(match[1], int(match[2]), match[3], ledger[match.end() : end])
        for match, end in zip(starts, ends, strict=True)
    ]


CLAIMS = read_claims()
each_claim = pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.label)


def test_the_ledger_holds_as_many_claims_as_the_paper_makes() -> None:
    assert 20 <= len(CLAIMS) <= 35
    assert [claim.number for claim in CLAIMS] == list(range(1, len(CLAIMS) + 1))
    assert len({claim.label for claim in CLAIMS}) == len(CLAIMS)
    assert len(re.findall(r"^### ", read_ledger(), re.MULTILINE)) == len(CLAIMS), "a block without its label"


@each_claim
def test_a_claim_says_where_the_paper_makes_it(claim: Claim) -> None:
    assert claim.place, "no line `**Paper** (place): ...`, or several"
    for part in claim.place.split("; "):
        assert PLACE.match(part), f"no place of the paper: {part}"


@each_claim
def test_a_claim_has_one_of_the_four_verdicts(claim: Claim) -> None:
    colour, words, reason = claim.verdict
    assert words in VERDICTS
    assert colour == COLOURS[VERDICTS[words]]
    if words == "cannot be tested without the data set":
        assert reason.startswith("Missing: ")


@each_claim
def test_a_claim_leads_to_a_chapter(claim: Claim) -> None:
    assert claim.chapters
    assert claim.chapters <= set(CHAPTERS)


@each_claim
def test_a_line_says_what_data_it_is_from_and_rests_on_something(claim: Claim) -> None:
    assert any(mark in OURS for mark, _ in claim.lines), "nothing of ours was said"
    for mark, line in claim.lines:
        assert mark in MARKS
        if mark in OURS:
            assert re.search(r"\{glue:text\}`|\]\(|\bnot (measured|trained|tested)\b", line), line


@each_claim
def test_no_number_of_ours_is_typed(claim: Claim) -> None:
    lines = [line for mark, line in claim.lines if mark in OURS] + [claim.verdict[2]]
    typed = [line for line in lines if re.search(r"\d", NAMES_AND_LIMITS.sub("", LINK.sub("", line)))]
    assert not typed


@each_claim
def test_a_block_holds_nothing_besides_its_parts(claim: Claim) -> None:
    """A line that is neither would escape the rules above; a heading of the next group may follow."""
    for line in claim.text.strip().splitlines():
        assert not line or re.match(r"\*\*(Paper|Verdict)\*\*|- \*\*[^*]+\*\*: |## ", line), line


def test_the_table_on_top_agrees_with_the_blocks() -> None:
    rows = re.findall(
        r"^\| \[(\d+)\]\((claim-[\w-]+)\) \| (.+) \| \{bdg-(\w+)-line\}`([^`]+)` \|$",
        read_ledger(),
        re.MULTILINE,
    )
    told = [(int(number), *row) for number, *row in rows]
    assert told == [
        (claim.number, claim.label, claim.title, claim.verdict[0], VERDICTS[claim.verdict[1]])
        for claim in CLAIMS
    ]


def test_the_counts_on_top_agree_with_the_blocks() -> None:
    counted = re.search(
        r"^Of (\d+) claims, \*\*(\d+)\*\* are reproduced, \*\*(\d+)\*\* reproduced in part, "
        r"\*\*(\d+)\*\* contradicted, and \*\*(\d+)\*\* cannot be tested without the data set\.$",
        read_ledger(),
        re.MULTILINE,
    )
    verdicts = [claim.verdict[1] for claim in CLAIMS]
    assert counted
    assert [int(number) for number in counted.groups()] == [
        len(CLAIMS),
        *(verdicts.count(verdict) for verdict in VERDICTS),
    ]


def test_every_choice_is_told_whole() -> None:
    """What was chosen, and for the paper's own open points also how much it matters, or that nobody knows."""
    page = (BOOK / "choices.md").read_text(encoding="utf-8")
    items = re.findall(r"^([^\s:#].+)\n((?:: .+\n?)+)", page, re.MULTILINE)
    assert len(items) > 40
    for term, told in items:
        assert told.startswith(": **Chosen:** "), term
        assert re.search(r"^: \*\*(Why|Matters):\*\* ", told, re.MULTILINE), term
