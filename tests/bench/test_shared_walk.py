"""The study of shared walks, small: what its numbers must obey, and that it would see a difference."""

from __future__ import annotations

import dataclasses

import pytest

from neurosim_core.bench.report import write_report
from neurosim_core.bench.shared_walk import measure_shared_walk, shared_walk_chapter


@pytest.fixture(scope="module")
def result():
    return measure_shared_walk(quick=True, device="cpu")


def test_nothing_is_seen_otherwise(result):
    walks = [("complete", 1), ("complete", 16), ("seen", 16)]
    assert [(c.part, c.lists, c.instants) for c in result.costs] == [
        (part, *walk) for part in ("slow", "fast") for walk in walks
    ]
    for cost in result.costs:
        if cost.lists == "seen":
            continue
        assert cost.pixel_count == 16 * 48 * 64
        assert cost.event_count > 100
        assert cost.differing_count == cost.other_event_count == 0
    (bar,) = shared_walk_chapter(result).bars
    assert bar.met


def test_numbers_agree_with_each_other(result):
    for cost in result.costs:
        assert 0.0 < cost.list_mean <= 256.0
        assert cost.too_long <= cost.asked < 0.9  # all rays of a tile whose list is too long, and some more
        assert min(cost.walk_s, cost.together_s, cost.alone_s) > 0.0


def test_lists_of_what_is_seen_are_shorter_and_hardly_differ(result):
    for whole, seen in zip(result.costs[1::3], result.costs[2::3], strict=True):
        assert (whole.lists, seen.lists) == ("complete", "seen")
        assert seen.list_mean < whole.list_mean
        limit = 0.02 if seen.part == "slow" else 0.3  # a tile of this small picture is a tenth of it
        assert seen.differing_count < limit * seen.pixel_count
    fast = result.costs[-1]
    assert fast.part == "fast"
    assert fast.differing_count > 0  # it is not the exact one under another name


def test_a_difference_misses_the_bar(result):
    for name in ("differing_count", "other_event_count"):
        other = dataclasses.replace(result.costs[1], **{name: 1})
        chapter = shared_walk_chapter(dataclasses.replace(result, costs=(other, *result.costs)))
        assert not chapter.bars[0].met


def test_report(result, tmp_path):
    write_report([shared_walk_chapter(result)], tmp_path)
    rows = (tmp_path / "shared-walk.csv").read_text().splitlines()
    assert len(rows) == 1 + len(result.costs)
    assert "64x48 px" in (tmp_path / "report.md").read_text()
