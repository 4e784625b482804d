"""Figures: what they must show, and that they can be compared byte by byte."""

import numpy as np
import pytest
from hand_made import cell, curve, flat_curve, problem, record, seed

from solar_cli.reporting.curves import Problem
from solar_cli.reporting.figures import DARK, PALE_PALETTE, PALETTE, label, learning_curve, render
from solar_cli.store.records import State

STEADY = [(0, 1.0), (10, 0.5), (20, 0.2)]


def axes_of(*curves):
    return learning_curve(problem(*curves)).axes[0]


@pytest.mark.parametrize(
    ("format", "start"), [("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")]
)
def test_the_same_curves_give_the_same_bytes(format, start):
    shown = problem(flat_curve("solar", [0.1, 0.2]), flat_curve("vae", [0.5, 0.6]))
    content = render(learning_curve(shown), format)
    assert content.startswith(start)
    again = learning_curve(shown)
    render(again, "png")  # another format first changes nothing
    assert render(again, format) == content


def test_the_legend_counts_seeds_and_everything_that_went_wrong():
    text = label(
        curve(
            seed(0, STEADY),
            seed(1, STEADY[:2], State.DIVERGED),
            seed(2, STEADY, State.RUNNING),
            extra=[record(cell(seed=3), State.FAILED)],
        )
    )
    assert [line.strip() for line in text.splitlines()] == [
        "solar, 3 seeds",
        "1 diverged (×)",
        "1 failed (+)",
        "1 unfinished",
    ]


@pytest.mark.parametrize("length", [4, 20, 40, 60])  # of a variant's name, which may have 60
def test_the_legend_lies_inside_the_figure(length):
    variant = ("training.learning_rate-0.001_" * 3)[:length]
    names = [f"solar:{variant}", f"vae:{variant}"]
    figure = learning_curve(problem(*(flat_curve(name, [0.1, 0.2]) for name in names)))
    [legend] = figure.legends
    shown, whole = legend.get_window_extent(), figure.bbox
    assert whole.x0 <= shown.x0 < shown.x1 <= whole.x1
    assert whole.y0 <= shown.y0 < shown.y1 <= whole.y1


def test_a_diverged_seed_is_marked_where_it_stopped_and_held_to_the_end():
    lines = axes_of(curve(seed(0, STEADY), seed(1, STEADY[:2], State.DIVERGED))).lines
    (mark,) = [line for line in lines if line.get_marker() == "x"]
    assert mark.get_xydata().tolist() == [[10, 0.5]]
    (held,) = [line for line in lines if line.get_linestyle() == ":"]
    assert held.get_xydata().tolist() == [[10, 1.0], [20, 1.0]]


def test_a_distance_that_falls_far_gets_a_logarithmic_axis_and_a_return_does_not():
    assert axes_of(flat_curve("solar", [0.01, 0.02])).get_yscale() == "log"
    assert axes_of(flat_curve("solar", [0.5, 0.6])).get_yscale() == "linear"


def test_episodes_of_very_different_methods_share_a_logarithmic_axis():
    near, far = flat_curve("solar", [0.5], 100), flat_curve("ppo", [0.5], 100_000)
    assert axes_of(near, far).get_xscale() == "symlog"
    assert axes_of(near).get_xscale() == "linear"


def test_a_logarithmic_axis_of_episodes_shows_where_a_curve_starts_and_ends():
    """Linear up to the first evaluation of any, so that iteration 0 has its place, and no more."""
    starts = [(0, 1.0), (50, 0.9), (240, 0.5)]
    late = [(0, 1.0), (50, 0.9), (240, 0.8), (20_000, 0.5)]
    axes = axes_of(curve(seed(0, starts)), curve(seed(0, late), label="ppo"))
    assert axes.get_xscale() == "symlog"
    low, high = axes.get_xlim()
    assert low == 0
    assert high >= 20_000
    named = axes.xaxis.get_major_formatter()
    assert [named(count) for count in (0, 10, 100, 10_000)] == ["0", "", "100", "10,000"]
    place = axes.transAxes.inverted().transform
    shown = [place(axes.transData.transform((count, 0.5)))[0] for count in (0, 50, 240, 20_000)]
    assert shown[0] == 0
    assert (np.diff(shown) > 0.05).all()
    assert shown[1] < 0.2


def test_levels_inside_the_figure_are_drawn_and_others_do_not_stretch_it():
    drawn = axes_of(flat_curve("solar", [0.3, 0.4]))
    flat = {tuple(line.get_ydata()) for line in drawn.lines}
    assert (0.5, 0.5) in flat
    assert (0.1, 0.1) not in flat


def test_names_are_never_read_as_formulas():
    odd = flat_curve("$\\frac{1}{2$", [0.3, 0.4])
    shown = Problem("$\\nope{", "nav", odd.measure, (odd,), ())
    assert render(learning_curve(shown), "svg").startswith(b"<?xml")


def test_curves_look_different_up_to_the_size_of_the_palette():
    assert len(set(PALETTE)) == len(set(PALE_PALETTE)) == len(PALETTE) == len(PALE_PALETTE)
    shown = learning_curve(problem(*(flat_curve(f"m{i}", [0.5]) for i in range(6))), DARK).axes[0]
    thick = [line for line in shown.lines if line.get_linewidth() == 2.0]
    assert [line.get_color() for line in thick] == list(PALE_PALETTE)


def test_what_learns_nothing_is_a_level_for_all_episodes():
    """It is evaluated for a few, and has no say in how episodes are drawn."""
    learned = curve(seed(0, [(0, 1.0), (1000, 0.45), (4000, 0.2)]))
    axes = axes_of(learned, flat_curve("zero", [0.9, 0.7]))
    assert axes.get_xscale() == "linear"
    assert axes_of(learned, flat_curve("vae", [0.9, 0.7])).get_xscale() == "symlog"
    levels = [line for line in axes.lines if np.ptp(line.get_ydata()) == 0]
    spans = [line for line in levels if line.get_transform() == axes.get_yaxis_transform()]
    assert {round(float(line.get_ydata()[0]), 6) for line in spans} == {
        0.8,
        0.5,
    }  # of the card 0.5 too
