"""The report as one HTML file: no network, no scripts, every stored text escaped."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from solar_cli.reporting.sections import ORIGIN_COLUMNS, CellLine, Section

TEMPLATES = Path(__file__).parent / "templates"


def page(
    sections: Sequence[Section],
    cells: Sequence[CellLine],
    origins: Sequence[tuple[str, ...]],
    made_by: str,
) -> str:
    """The whole page; ``made_by`` names the code that wrote the report."""
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"data_uri": data_uri, "zip": zip}
    return environment.get_template("page.html").render(
        sections=sections,
        cells=cells,
        failed=[line for line in cells if line.failed],
        stale=[line for line in cells if line.stale],
        warnings=[
            f"{part.problem.title}: {line}" for part in sections for line in part.health.warnings
        ],
        origins=origins,
        origin_columns=ORIGIN_COLUMNS,
        made_by=made_by,
    )


def data_uri(content: bytes, kind: str) -> str:
    """A picture inside the page."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
