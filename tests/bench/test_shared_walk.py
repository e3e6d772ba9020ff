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
    assert [(c.part, c.instants) for c in result.costs] == [(p, m) for p in ("slow", "fast") for m in (1, 16)]
    for cost in result.costs:
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
