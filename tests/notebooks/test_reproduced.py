"""The numbers of a profile's build against its reference, as `make check` compares them."""

import check


def test_build_reproduces_the_reference(profile: dict) -> None:
    rows = check.compare_build(profile)
    assert [row.told() for row in rows if row.result in (check.OUTSIDE, check.MISSING)] == []
