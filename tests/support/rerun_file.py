"""Rerun files, read back."""

from __future__ import annotations

import warnings
from collections import defaultdict
from pathlib import Path
from typing import Any

import rerun.chunk

Rows = dict[str, list[tuple[int | None, dict[str, Any]]]]


def read(path: Path) -> Rows:
    """Rows of each entity: (time [ns] or None if static, values by name of the component)."""
    rows: Rows = defaultdict(list)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "RRD file has no footer")  # a live file has none
        reader = rerun.chunk.RrdReader(path)
    for chunk in reader.stream():
        batch = chunk.to_record_batch()
        names = batch.schema.names
        times = batch.column(names.index("sim_time")) if "sim_time" in names else None
        for row in range(batch.num_rows):
            values = {
                name.rsplit(":", 1)[-1]: batch.column(index)[row].as_py()
                for index, name in enumerate(names)
                if ":" in name
            }
            stamp_ns = None if times is None else int(times[row].value)
            rows[chunk.entity_path].append((stamp_ns, values))
    return {entity: sorted(found, key=lambda item: item[0] or 0) for entity, found in rows.items()}


def scalars(rows: Rows, entity: str) -> list[tuple[int, list[float]]]:
    """The points of a plot: (time [ns], values); none if there is no such plot."""
    return [(t, values["scalars"]) for t, values in rows.get(entity, []) if t is not None]
