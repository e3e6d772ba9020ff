"""The look of plots: one size, colours that the colour-blind tell apart, readable at 1200 px."""

from __future__ import annotations

import importlib.util
import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurosim_core.bench.chapter import Plot
from neurosim_core.install import install_hint

if TYPE_CHECKING:
    from matplotlib.axis import Axis

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Of lines, in turn.

Reference: Okabe and Ito (2008), Color Universal Design, without its yellow, which is faint on white.
"""
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
"""Of lines, in turn: nothing is told by colour alone."""

_SIZE_IN = (8.0, 4.8)
_DPI = 150  # 1200 px wide
_NOTE_PT = 6.0
_STYLE = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.grid.which": "both",
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "axes.labelsize": 9,
    "figure.facecolor": "white",
    "figure.titlesize": 11,
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "grid.alpha": 0.25,
    "grid.linewidth": 0.6,
    "legend.fontsize": 8,
    "legend.framealpha": 0.85,
    "lines.linewidth": 1.6,
    "lines.markersize": 5,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
}


def plain_ticks(axis: Axis) -> None:
    """Label a logarithmic axis that spans one or two decades at 1, 2 and 5, without exponents."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def can_draw() -> bool:
    """Return whether the library that draws is installed."""
    return importlib.util.find_spec("matplotlib") is not None


def draw_plot(plot: Plot, *, notes: Sequence[str] = ()) -> bytes:
    """Return a plot as PNG, 1200 px wide unless its `draw` says otherwise.

    Args:
        plot: What to draw.
        notes: Lines below it, on the machine and the like.

    Raises:
        ImportError: The library that draws is not installed.
    """
    if not can_draw():
        raise ImportError(f"plots need matplotlib: {install_hint('view')}")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with _look():
        figure = Figure(figsize=_SIZE_IN, dpi=_DPI, layout="constrained")
        FigureCanvasAgg(figure)
        figure.suptitle(plot.title, x=0.01, ha="left")
        plot.draw(figure)
        if notes:
            height = 1.3 * _NOTE_PT / 72.0 * len(notes) / figure.get_figheight()
            figure.set_layout_engine("constrained", rect=(0.0, height + 0.01, 1.0, 0.99 - height))
            figure.text(0.01, 0.01, "\n".join(notes), size=_NOTE_PT, va="bottom", family="monospace")
        data = io.BytesIO()
        figure.savefig(data, format="png", dpi=_DPI)
    return data.getvalue()


@contextmanager
def _look() -> Iterator[None]:
    import matplotlib
    from cycler import cycler

    cycle = cycler(color=COLORS) + cycler(marker=MARKERS)
    settings: dict[Any, Any] = {**matplotlib.rcParamsDefault, **_STYLE, "axes.prop_cycle": cycle}
    with matplotlib.rc_context(settings):
        yield


def save_plot(plot: Plot, folder: Path, *, notes: Sequence[str] = ()) -> Path:
    """Write `<name>.png` and return its path; see `draw_plot`."""
    file = folder / f"{plot.name}.png"
    file.write_bytes(draw_plot(plot, notes=notes))
    return file
