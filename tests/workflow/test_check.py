"""The comparison of a build with its reference numbers, on a small build, and the reference files themselves."""

import json
import re
from pathlib import Path

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_notebook, new_output

import check
import stage_book
from chapters import CHAPTERS, ROOT, ChapterError, load_config

PROFILES = ("demo", "smoke")
METRICS = "file:localization/seq01/paper/metrics.json#rmse_m"
ENTRIES = [
    {"name": "speed", "chapter": "02_alignment", "session": "seq01", "from": "glue:speed", "value": 9.5},
    {"name": "share", "chapter": "01_sessions", "from": "glue:words[1]", "value": 1234.5},
    {"name": "RMSE", "chapter": "07_localization", "from": METRICS, "value": 0.25, "seed_tol": 0.1},
    {"name": "near the map", "chapter": "10_real_radar", "from": "file:scans.csv#share", "value": 0.5},
]


def write_json(path: Path, content: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def glue(path: Path, **values: object) -> None:
    outputs = [
        new_output(
            "display_data",
            data={"application/papermill.record/text/plain": repr(value)},
            metadata={"scrapbook": {"mime_prefix": "application/papermill.record/", "name": name}},
        )
        for name, value in values.items()
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    nbformat.write(new_notebook(cells=[new_code_cell("glue", outputs=outputs)]), path)


def write_reference(folder: Path, entries: list[dict]) -> None:
    common = {"abs_tol": 0.01, "kind": "exact", "reason": "a reason"}
    reference = {"profile": "tiny", "seed": 1, "machine": {}, "numbers": [common | e for e in entries]}
    write_json(folder / "tiny.json", reference)


@pytest.fixture
def build(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict:
    """A small build with its reference, and the settings of its profile."""
    monkeypatch.setattr(check, "REFERENCE", tmp_path)
    monkeypatch.setattr(check, "ROOT", tmp_path)
    monkeypatch.setattr(check, "find_real_root", lambda given: tmp_path)
    glue(tmp_path / "out/notebooks/02_alignment/seq01.ipynb", speed=9.5)
    glue(tmp_path / "out/notebooks/01_sessions.ipynb", words="88 % of 1,234.5 peaks")
    metrics = {"session": "seq01", "method": "paper", "seed": 1, "rmse_m": 0.25}
    write_json(tmp_path / "out/localization/seq01/paper/metrics.json", metrics)
    (tmp_path / "out/scans.csv").write_text("stamp,share\n1,0.25\n2,0.75\n", encoding="utf-8")
    write_reference(tmp_path, ENTRIES)
    return {"profile": "tiny", "seed": 1, "out_dir": str(tmp_path / "out")}


def results(config: dict) -> dict[str, str]:
    return {row.entry["name"]: row.result for row in check.compare_build(config)}


# ---- a build --------------------------------------------------------------------------------------------------


def test_numbers_of_notebooks_json_and_csv_files_are_found(build: dict) -> None:
    assert set(results(build).values()) == {check.WITHIN}


@pytest.mark.parametrize("changed", range(len(ENTRIES)))
def test_changed_reference_is_named(build: dict, capsys: pytest.CaptureFixture, changed: int) -> None:
    entries = [dict(entry) for entry in ENTRIES]
    entries[changed]["value"] *= 1.1
    write_reference(check.REFERENCE, entries)
    rows = check.compare_build(build)
    assert [row.result for row in rows].count(check.OUTSIDE) == 1
    check.print_table(rows)
    out = capsys.readouterr().out
    assert f"OUTSIDE: {entries[changed]['chapter']}, {entries[changed]['name']}: " in out
    assert "What to look at (exact): " in out


@pytest.mark.parametrize(
    ("source", "fault"),
    [
        ("glue:sped", "sessions.ipynb holds no number `glue:sped`"),
        ("glue:words[7]", "holds no number `glue:words[7]`"),
        ("file:scans.csv#part", "scans.csv holds no number `file:scans.csv#part`"),
        ("file:gone.csv#share", "no file "),
        ("words", "`words` is neither"),
    ],
)
def test_source_that_is_gone_is_a_fault_with_chapter_and_key(build: dict, source: str, fault: str) -> None:
    write_reference(check.REFERENCE, [{"name": "n", "chapter": "01_sessions", "from": source, "value": 88.0}])
    (row,) = check.compare_build(build)
    assert row.result == check.MISSING
    assert row.told().startswith("MISSING: 01_sessions, n: ") and fault in row.told() and source in row.told()


def test_missing_notebook_is_a_fault_with_its_path(build: dict) -> None:
    Path(build["out_dir"], "notebooks/02_alignment/seq01.ipynb").unlink()
    told = [row.told() for row in check.compare_build(build) if row.result == check.MISSING]
    assert len(told) == 1 and "02_alignment/seq01.ipynb for `glue:speed`" in told[0]


def test_number_on_real_data_is_skipped_only_without_the_data(
    build: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_reference(check.REFERENCE, [ENTRIES[3] | {"real": True}])
    Path(build["out_dir"], "scans.csv").unlink()
    assert results(build) == {"near the map": check.MISSING}
    monkeypatch.setattr(check, "find_real_root", lambda given: None)
    assert results(build) == {"near the map": check.SKIPPED}


def test_renewed_reference_takes_values_and_keeps_the_rest(build: dict) -> None:
    write_reference(check.REFERENCE, [entry | {"value": 0.0} for entry in ENTRIES])
    before = check.read_reference("tiny")["numbers"]
    check.renew(build | {"seed": 5})
    after = check.read_reference("tiny")
    assert [entry.pop("value") for entry in after["numbers"]] == [entry["value"] for entry in ENTRIES]
    assert after["numbers"] == [{k: v for k, v in entry.items() if k != "value"} for entry in before]
    assert after["seed"] == 5 and after["machine"]["Python"]


def test_reference_is_not_renewed_while_a_source_is_gone(build: dict) -> None:
    before = (check.REFERENCE / "tiny.json").read_bytes()
    Path(build["out_dir"], "scans.csv").unlink()
    with pytest.raises(ChapterError, match="near the map: no file"):
        check.renew(build)
    assert (check.REFERENCE / "tiny.json").read_bytes() == before


# ---- one rerun ------------------------------------------------------------------------------------------------


def compare_rerun(folder: Path, **changes: object) -> list[check.Row]:
    metrics = {"session": "seq01", "method": "paper", "seed": 1, "rmse_m": 0.25} | changes
    return check.compare_run(check.read_reference("tiny"), write_json(folder / "mine.json", metrics))


def test_rerun_is_compared_with_its_session_and_method(build: dict, tmp_path: Path) -> None:
    (row,) = compare_rerun(tmp_path)
    assert (row.entry["name"], row.result) == ("RMSE", check.WITHIN)
    assert [row.result for row in compare_rerun(tmp_path, rmse_m=0.3)] == [check.OUTSIDE]


@pytest.mark.parametrize("other", [{"session": "seq09"}, {"method": "robust"}])
def test_rerun_without_a_reference_is_refused(build: dict, tmp_path: Path, other: dict) -> None:
    with pytest.raises(ChapterError, match="mine.json: no reference for session "):
        compare_rerun(tmp_path, **other)


def test_rerun_with_another_seed_is_compared_within_the_spread(
    build: dict, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert [row.result for row in compare_rerun(tmp_path, seed=2, rmse_m=0.34)] == [check.WITHIN]
    out = capsys.readouterr().out
    assert "seed 2 (reference: seed 1; compared within the spread between seeds)" in out
    assert [row.result for row in compare_rerun(tmp_path, seed=2, rmse_m=0.36)] == [check.OUTSIDE]


@pytest.mark.parametrize("text", ["", "[]", '{"session": "seq01"}'])
def test_file_that_is_no_metrics_is_refused(build: dict, tmp_path: Path, text: str) -> None:
    (tmp_path / "mine.json").write_text(text, encoding="utf-8")
    with pytest.raises(ChapterError, match="mine.json: not a readable metrics.json"):
        check.compare_run(check.read_reference("tiny"), tmp_path / "mine.json")


# ---- the page -------------------------------------------------------------------------------------------------


def test_page_shows_every_number_and_both_machines(build: dict) -> None:
    page = stage_book.reproduced_page(build)
    assert "{{" not in page
    assert "| RMSE | 0.25 | 0.25 | 0.01 | within | exact: a reason |" in page
    assert "### [Chapter 7](notebooks/07_localization.ipynb)" in page
    assert "| within | 4 |" in page and "| Python |  |" in page


def test_page_of_a_profile_without_a_reference_is_empty(build: dict) -> None:
    assert "| all | 0 |" in stage_book.reproduced_page(build | {"profile": "mine"})


# ---- the reference files --------------------------------------------------------------------------------------


@pytest.mark.parametrize("profile", PROFILES)
def test_every_chapter_has_numbers_with_value_tolerance_and_reason(profile: str) -> None:
    numbers = check.read_reference(profile)["numbers"]
    kinds = re.findall(r"^(\w+)\n: ", check.PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert {entry["chapter"] for entry in numbers} == set(CHAPTERS)
    assert len({(entry["chapter"], entry["name"]) for entry in numbers}) == len(numbers)
    for entry in numbers:
        assert isinstance(entry["value"], int | float), entry["name"]
        assert ("abs_tol" in entry) != ("rel_tol" in entry), entry["name"]
        assert entry["kind"] in kinds and len(entry["reason"]) > 10, entry["name"]
        assert entry["kind"] == "exact" or entry.get("rel_tol", 1) > 0, entry["name"]
        assert check.SOURCE.match(entry["from"]), entry["name"]
        assert "metrics.json" not in entry["from"] or entry["seed_tol"] > 0, entry["name"]


@pytest.mark.parametrize("profile", PROFILES)
def test_every_localization_run_has_a_reference(profile: str) -> None:
    config = load_config(ROOT / f"config/{profile}.yaml")
    sources = " ".join(entry["from"] for entry in check.read_reference(profile)["numbers"])
    for session in config["sessions"][1:]:
        for method in config["methods"]:
            assert f"localization/{session}/{method}/metrics.json#" in sources
