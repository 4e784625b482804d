"""The learning curve of a problem: mean line, band of one std, a thin line a seed.

Figures are made without pyplot's global state and carry no date: same curves, same bytes.
"""

from __future__ import annotations

import io
import textwrap
from dataclasses import dataclass
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from solar_cli.reporting.curves import Curve, Problem, SeedCurve
from solar_cli.reporting.summary import title
from solar_cli.reporting.tables import number
from solar_cli.settings.registry import is_level
from solar_cli.store.records import State
from solar_cli.wording import counted

FileFormat = Literal["png", "svg", "pdf"]

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Okabe and Ito 2008: told apart with any common colour blindness."""
PALE_PALETTE = ("#4FA8E0", "#F08040", "#2FBF8F", "#E093BF", "#F0B840", "#8FD0F5")
"""The same hues, lighter, for a dark ground."""
DASHES: tuple[tuple[float, ...], ...] = ((), (5, 1.5), (1.5, 1.5), (6, 1.5, 1.5, 1.5))
"""Up to four curves differ by more than their colour."""
LEGEND_COLUMNS = 2
"""Below the axes, so that the figure stays readable at the width of a phone."""
LONG_LABEL, LONGEST_LINE = 30, 64
"""Characters from which on a label needs both columns, and that there is room for in them."""
LOG_SPAN = 20.0
"""A measure whose best mean is this many times below its worst gets a logarithmic axis."""
LOG_EPISODES = 10.0
"""Curves whose ends differ by more than this factor get a logarithmic axis of episodes."""


@dataclass(frozen=True)
class Theme:
    """Colours of a figure."""

    ink: str
    faint: str
    paper: str | None
    """None leaves the ground transparent"""
    palette: tuple[str, ...]
    """of the curves, in their order"""


LIGHT = Theme("#1f2328", "#8c959f", "#ffffff", PALETTE)
DARK = Theme("#e6edf3", "#7d8590", None, PALE_PALETTE)

STYLE: dict[Any, Any] = {
    "font.size": 11,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "axes.labelsize": 11,
    "axes.titlesize": 12,
    "legend.fontsize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.solid_capstyle": "round",
    "text.parse_math": False,  # a $ in a stored name is a $
    "svg.hashsalt": "solar",
    "pdf.fonttype": 42,
    "savefig.dpi": 200,
}


def learning_curve(problem: Problem, theme: Theme = LIGHT) -> Figure:
    """The headline measure of every curve of a problem against episodes."""
    measure = problem.measure
    with mpl.rc_context(STYLE):
        lines = [line for curve in problem.curves for line in label(curve).splitlines()]
        columns = LEGEND_COLUMNS if max(map(len, lines)) <= LONG_LABEL else 1
        rows = -(-len(problem.curves) // columns)
        figure = Figure(figsize=(5.6, 3.8 + 0.35 * rows), layout="constrained")
        axes = figure.add_subplot()
        for index, curve in enumerate(problem.curves):
            dashes = DASHES[index % len(DASHES)]
            _draw(axes, curve, theme.palette[index % len(theme.palette)], dashes)
        _scale(axes, problem)
        _levels(axes, measure.levels, theme)
        axes.set_title(problem.title, loc="left", fontweight="bold", color=theme.ink)
        axes.set_xlabel("episodes", color=theme.ink)
        axes.set_ylabel(
            textwrap.fill(title(measure.headline, measure.unit, measure.better), 40),
            color=theme.ink,
        )
        figure.legend(
            loc="outside lower center",
            ncols=min(columns, len(problem.curves)),
            frameon=False,
            labelcolor=theme.ink,
        )
        _colour(figure, axes, theme)
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # one layout for all formats, whichever is first
    return figure


def _draw(axes: Axes, curve: Curve, colour: str, dashes: tuple[float, ...]) -> None:
    for seed in curve.seeds:
        axes.plot(seed.episodes, seed.values, color=colour, linewidth=0.7, alpha=0.35)
        if (mark := _mark(seed)) is not None:
            last = (seed.episodes[-1:], seed.values[-1:])
            axes.plot(*last, mark, color=colour, markersize=7, markeredgewidth=1.6)
        if seed.diverged and seed.episodes[-1] < curve.end:
            held = (seed.episodes[-1], curve.end)
            axes.plot(held, [seed.penalty] * 2, ":", color=colour, linewidth=0.9, alpha=0.6)
    mean, std = curve.mean, curve.std
    if is_level(curve.method):
        axes.axhline(mean[-1], color=colour, linewidth=0.9, dashes=(1, 2), zorder=1)
    if std is not None:
        axes.fill_between(curve.grid, mean - std, mean + std, color=colour, alpha=0.18, linewidth=0)
    axes.plot(
        curve.grid,
        mean,
        color=colour,
        linewidth=2.0,
        dashes=dashes,
        marker="o" if len(curve.grid) == 1 else None,
        label=label(curve),
    )


def _mark(seed: SeedCurve) -> str | None:
    """What a seed's line ends with: a cross where it diverged, a plus where the program failed."""
    if seed.diverged:
        return "x"
    return "+" if seed.record.state is State.FAILED else None


def label(curve: Curve) -> str:
    """``solar, 10 seeds``, and every cell that did not finish."""
    count = len(curve.seeds)
    diverged = sum(seed.diverged for seed in curve.seeds)
    failed = curve.count(State.FAILED)
    unfinished = curve.count(State.PENDING, State.RUNNING, State.INTERRUPTED)
    lines = textwrap.wrap(f"{curve.label}, {counted(count, 'seed')}", LONGEST_LINE)
    lines += [f"{diverged} diverged (×)"] * bool(diverged)
    lines += [f"{failed} failed (+)"] * bool(failed)
    lines += [f"{unfinished} unfinished"] * bool(unfinished)
    return "\n    ".join(lines)


def _scale(axes: Axes, problem: Problem) -> None:
    """Limits from what was measured, not from the band; logarithmic where that shows more."""
    means = np.concatenate([curve.mean for curve in problem.curves])
    measured = np.concatenate([seed.values for curve in problem.curves for seed in curve.seeds])
    learning = [curve for curve in problem.curves if not is_level(curve.method)]
    ends = [
        max(int(seed.episodes[-1]) for seed in curve.seeds) for curve in learning or problem.curves
    ]
    positive = problem.measure.better == "lower" and measured.min() > 0
    if positive and means.max() > LOG_SPAN * means.min():
        axes.set_yscale("log")
        axes.set_ylim(measured.min() / 1.3, measured.max() * 1.3)
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: number(value)))
        axes.yaxis.set_minor_formatter(NullFormatter())
    else:
        margin = 0.06 * (np.ptp(measured) or abs(measured[0]) or 1.0)
        axes.set_ylim(measured.min() - margin, measured.max() + margin)
    if min(ends) > 0 and max(ends) > LOG_EPISODES * min(ends):
        counts = np.concatenate([seed.episodes for curve in problem.curves for seed in curve.seeds])
        # Before the first of them nothing is known: iteration 0 has its place, and no more.
        first = int(counts[counts > 0].min())
        axes.set_xscale("symlog", linthresh=first, linscale=0.4)
        axes.xaxis.set_major_formatter(
            FuncFormatter(lambda value, _: "" if 0 < value < first else f"{value:,.0f}")
        )
        axes.set_xlim(left=0)
    else:
        axes.set_xlim(0, 1.02 * max(ends) or 1)


def _levels(axes: Axes, levels: tuple[float, ...], theme: Theme) -> None:
    low, high = axes.get_ylim()
    for level in levels:
        if low <= level <= high:
            axes.axhline(level, color=theme.faint, linewidth=0.6, dashes=(4, 3), zorder=0)


def _colour(figure: Figure, axes: Axes, theme: Theme) -> None:
    for ground in (figure.patch, axes.patch):
        ground.set_facecolor(theme.paper or "none")
    axes.tick_params(which="both", colors=theme.ink)
    for name in ("left", "bottom"):
        axes.spines[name].set_color(theme.faint)


def render(figure: Figure, format: FileFormat) -> bytes:
    """The bytes of a figure, the same for the same curves."""
    dateless = {"svg": {"Date": None}, "pdf": {"CreationDate": None}, "png": {"Software": None}}
    file = io.BytesIO()
    with mpl.rc_context(STYLE):
        figure.savefig(file, format=format, metadata=dateless[format])
    return file.getvalue()
