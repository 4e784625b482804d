"""A listing on a screen that is too narrow for it: one line a row, by leaving out and cutting."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from solar_cli.cli.printing import clean, table

if TYPE_CHECKING:
    from rich.table import Table

SPARE = ("iteration>", "computing>", "headline measure")
"""Columns that a narrow screen goes without, in this order."""
CUT, SHORTEST_CUT = "variant", 5
"""The column whose text is cut next, and to how much; it is never left out."""
LAST = "value>"
"""The column that a screen goes without that is narrower still."""
NOTE, SHORTEST_NOTE = "note", 10
"""The column that gets what is left, if that is enough to say anything."""
GAP = 2
"""Blanks between two columns of a narrow table."""
FRAME = 3, 2
"""Blanks between two columns, and on both sides together, of an ordinary table."""


def fitted(columns: Sequence[str], rows: Sequence[Sequence[object]], width: int) -> Table:
    """The table of ``rows`` in ``width`` characters; the whole of it where there is room."""
    from rich.cells import cell_len

    def longest(place: int, name: str) -> int:
        texts = [clean("" if row[place] is None else row[place]) for row in rows]
        return max(map(cell_len, [name.rstrip(">"), *texts]))

    widths = {name: longest(place, name) for place, name in enumerate(columns)}
    between, around = FRAME
    if sum(widths.values()) + between * (len(widths) - 1) + around <= width:
        return table(columns, rows)
    note = widths.pop(NOTE, 0)

    def excess() -> int:
        return sum(widths.values()) + GAP * (len(widths) - 1) - width

    for name in SPARE:
        if name in widths and excess() > 0:
            del widths[name]
    whole = widths[CUT]
    for _ in range(2):
        room = max(widths[CUT] - excess(), SHORTEST_CUT)
        widths[CUT] = min(whole, room)
        if excess() > 0:
            widths.pop(LAST, None)
    left = -excess() - GAP
    if note and left >= SHORTEST_NOTE:
        widths[NOTE] = min(note, left)
    names = [name for name in columns if name in widths]
    places = [columns.index(name) for name in names]
    return table(names, [[row[place] for place in places] for row in rows], cut_to=widths)
