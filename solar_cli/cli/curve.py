"""A curve drawn with Braille characters, two by four dots each."""

from __future__ import annotations

import math
from collections.abc import Sequence

DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
"""Bit of each dot in a Braille character, by row and column (Unicode, block 2800)."""
BLANK = 0x2800
PLAIN = {"│": "|", "└": "+", "─": "-"}
LOGARITHMIC = 30.0
"""Ratio of the largest to the smallest value from which the vertical axis is logarithmic."""


def plot(
    xs: Sequence[float],
    ys: Sequence[float],
    width: int = 60,
    height: int = 12,
    encoding: str = "utf-8",
) -> list[str]:
    """Lines of text that show ``ys`` over ``xs``; what is not finite leaves a gap.

    ``width`` and ``height`` are those of the plot area in characters. Where ``encoding`` has no
    Braille, they are drawn with stars.
    """
    finite = [y for y in ys if math.isfinite(y)]
    if not finite:
        return ["(no finite value yet)"]
    low, high = min(finite), max(finite)
    scale = math.log10 if low > 0 and high / low >= LOGARITHMIC else float
    bottom, top = scale(low), scale(high)
    first, last = min(xs), max(xs)
    masks = [[0] * width for _ in range(height)]
    previous: tuple[int, int] | None = None
    for x, y in zip(xs, ys, strict=True):
        if not math.isfinite(y):
            previous = None
            continue
        column = _position(x, first, last, 2 * width - 1)
        row = 4 * height - 1 - _position(scale(y), bottom, top, 4 * height - 1)
        for dot_column, dot_row in _segment(previous or (column, row), (column, row)):
            masks[dot_row // 4][dot_column // 2] |= DOTS[dot_row % 4][dot_column % 2]
        previous = (column, row)
    labels = [""] * height
    labels[-1], labels[0] = f"{low:.4g}", f"{high:.4g}"
    margin = max(map(len, labels))
    lines = [
        f"{label:>{margin}} │{''.join(chr(BLANK + mask) for mask in row)}"
        for label, row in zip(labels, masks, strict=True)
    ]
    ends = f"{first:g}".ljust(width - len(f"{last:g}")) + f"{last:g}"
    axis = f"{' ' * margin} └{'─' * width}"
    scales = ", logarithmic" if scale is math.log10 else ""
    drawn = [*lines, axis, f"{' ' * margin}  {ends} episodes{scales}"]
    try:
        "".join(drawn).encode(encoding)
    except UnicodeEncodeError:
        return ["".join(PLAIN.get(sign) or _star(sign) for sign in line) for line in drawn]
    return drawn


def _star(sign: str) -> str:
    """A star for a character of the plot that has any dot."""
    return sign if ord(sign) < BLANK else " *"[ord(sign) > BLANK]


def _position(value: float, low: float, high: float, steps: int) -> int:
    return steps // 2 if high == low else round((value - low) / (high - low) * steps)


def _segment(start: tuple[int, int], end: tuple[int, int]) -> list[tuple[int, int]]:
    """The dots on the straight line between two dots, both included."""
    count = max(abs(end[0] - start[0]), abs(end[1] - start[1]), 1)
    return [
        (
            round(start[0] + (end[0] - start[0]) * step / count),
            round(start[1] + (end[1] - start[1]) * step / count),
        )
        for step in range(count + 1)
    ]
