"""Tables of text as Markdown and LaTeX, and how their numbers are written."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from solar_cli.reporting.statistics import Bounded, Interval

LATEX = {
    "\\": r"\textbackslash{}",
    **{character: "\\" + character for character in "&%$#_{}"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    "∞": r"$\infty$",
    "×": r"$\times$",
    "−": r"$-$",
    "<": r"$<$",
    ">": r"$>$",
}


@dataclass(frozen=True)
class Table:
    """Cells of text under headings, and the notes that belong to them."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()

    def to_markdown(self) -> str:
        """A pipe table; the notes are a list below it."""
        lines = [_pipes(self.columns), "|" + "---|" * len(self.columns)]
        lines += [_pipes(row) for row in self.rows]
        if self.notes:
            lines += ["", *(f"- {markdown(note)}" for note in self.notes)]
        return "\n".join(lines) + "\n"

    def to_latex(self) -> str:
        """A tabular with the rules of booktabs; the notes follow it, one a line."""
        lines = [
            r"% needs \usepackage{booktabs}",
            rf"\begin{{tabular}}{{l{'r' * (len(self.columns) - 1)}}}",
            r"\toprule",
            _ampersands(self.columns),
            r"\midrule",
            *(_ampersands(row) for row in self.rows),
            r"\bottomrule",
            r"\end{tabular}",
        ]
        if self.notes:
            lines += ["", r"{\footnotesize", *(latex(note) + r" \\" for note in self.notes), "}"]
        return "\n".join(lines) + "\n"


def _pipes(cells: Sequence[str]) -> str:
    return "| " + " | ".join(markdown(cell) for cell in cells) + " |"


def one_line(text: str) -> str:
    """``text`` without line breaks and without anything that a terminal would obey."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def markdown(text: str) -> str:
    """Inert in a line or a cell: what might start a tag or an entity is escaped."""
    text = re.sub(r"&(?=[#\w])", "&amp;", one_line(text))
    return re.sub(r"<(?=\S)", "&lt;", text).replace("|", "\\|")


def _ampersands(cells: Sequence[str]) -> str:
    return " & ".join(latex(cell) for cell in cells) + r" \\"


def latex(text: str) -> str:
    """``text`` as LaTeX shows it, special characters escaped."""
    return "".join(LATEX.get(character, character) for character in one_line(text))


def number(value: float) -> str:
    """Three significant digits, or whole from a hundred on."""
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def interval(shown: Interval | None) -> str:
    """``[low, high]``, with its measured coverage where it carries one; a dash without interval."""
    if shown is None:
        return "-"
    text = f"[{number(shown.low)}, {number(shown.high)}]"
    return text if shown.coverage is None else f"{text} (covers {shown.coverage:.2f})"


def bounded(value: Bounded) -> str:
    """``80``, ``> 240`` for a lower bound, ``< 3`` for an upper one."""
    if value.low == value.high:
        return number(value.low)
    low, high = number(value.low), number(value.high)
    if value.low == 0:
        return "unknown" if math.isinf(value.high) else f"< {high}"
    return f"> {low}" if math.isinf(value.high) else f"{low} to {high}"


def ranges(numbers: Sequence[int]) -> str:
    """``0-4, 7``: whole numbers in as few characters as it takes."""
    spans: list[list[int]] = []
    for value in sorted(numbers):
        if spans and value == spans[-1][-1] + 1:
            spans[-1] = [spans[-1][0], value]
        else:
            spans.append([value, value])
    return ", ".join(str(low) if low == high else f"{low}-{high}" for low, high in spans)
