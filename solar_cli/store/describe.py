"""``docs/schema.md``: ``python -m solar_cli.store.describe > docs/schema.md``.

The tables are read from a database that the migrations made; what a column means is said in
`solar_cli.store.schema`.
"""

from __future__ import annotations

from sqlalchemy import Connection, Inspector, create_engine, inspect

from solar_cli.store.migrate import upgrade
from solar_cli.store.schema import HEAD, Base

HEADER = f"""# The store's tables

Schema `{HEAD}`, as the migrations make it on SQLite; PostgreSQL has the same tables. This page is
generated: `python -m solar_cli.store.describe > docs/schema.md`.

Times are in UTC. A cell's files lie in `cells/HASH/`, beside `solar.db`; another SQLite file
`NAME` has them in `NAME.files/cells/HASH/`, a PostgreSQL database in `SOLAR_HOME` or else in
`runs/DATABASE.files/`. Read tables from Python with `solar_cli.load()`, or with any SQL client.
"""


def page() -> str:
    """The page, from a fresh database in memory."""
    engine = create_engine("sqlite://")
    with engine.connect() as connection:
        upgrade(connection)
        return HEADER + "".join(_tables(connection))


def _tables(connection: Connection) -> list[str]:
    found = inspect(connection)
    return [_table(found, name) for name in Base.metadata.tables]


def _table(found: Inspector, name: str) -> str:
    table = Base.metadata.tables[name]
    summary = next(
        mapper.class_.__doc__ or ""
        for mapper in Base.registry.mappers
        if mapper.local_table is table
    )
    keys = found.get_pk_constraint(name)["constrained_columns"]
    references = {
        key["constrained_columns"][0]: f"{key['referred_table']}.{key['referred_columns'][0]}"
        for key in found.get_foreign_keys(name)
    }
    lines = [f"\n## {name}\n", f"{summary}\n"]
    lines += ["| column | type | null | meaning |", "|---|---|---|---|"]
    for column in found.get_columns(name):
        label = column["name"]
        marks = ["key"] if label in keys else []
        if label in references:
            marks.append(f"to {references[label]}")
        mark = f" ({', '.join(marks)})" if marks else ""
        null = "yes" if column["nullable"] else ""
        meaning = table.columns[label].doc
        lines.append(f"| `{label}`{mark} | {column['type']} | {null} | {meaning} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(page(), end="")
