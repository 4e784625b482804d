"""The first schema."""

import sqlalchemy as sa
from alembic import op

revision = "solar_0001"
down_revision = None

# Text sorts by its bytes on every database, so that listings are the same.
TEXT = sa.Text().with_variant(sa.Text(collation="C"), "postgresql")
MOMENT = sa.DateTime(timezone=True)


def upgrade() -> None:
    """Create all tables."""
    op.create_table(
        "cell",
        sa.Column("hash", TEXT, primary_key=True),
        sa.Column("task", TEXT, nullable=False),
        sa.Column("method", TEXT, nullable=False),
        sa.Column("variant", TEXT, nullable=False),
        sa.Column("seed", sa.BigInteger, nullable=False),
        sa.Column("configuration", TEXT, nullable=False),
        sa.Column("created", MOMENT, nullable=False),
        sa.Column("iteration", sa.BigInteger, nullable=False),
        sa.Column("episodes", sa.BigInteger, nullable=False),
        sa.Column("steps", sa.BigInteger, nullable=False),
        sa.Column("simulated_seconds", sa.Double, nullable=False),
        sa.Column("seconds", sa.Double, nullable=False),
    )
    op.create_table(
        "attempt",
        _cell(),
        sa.Column("number", sa.BigInteger, primary_key=True, autoincrement=False),
        sa.Column("host", TEXT, nullable=False),
        sa.Column("pid", sa.BigInteger, nullable=False),
        sa.Column("process_start", sa.Double, nullable=False),
        sa.Column("boot", TEXT, nullable=False),
        sa.Column("started", MOMENT, nullable=False),
        sa.Column("heartbeat", MOMENT, nullable=False),
        sa.Column("ended", MOMENT),
        sa.Column("outcome", TEXT),
        sa.Column("error", TEXT),
        sa.Column("target", sa.BigInteger, nullable=False),
        sa.Column("activity", TEXT, nullable=False),
        sa.Column("fraction", sa.Double, nullable=False),
        sa.Column("provenance", sa.JSON, nullable=False),
    )
    op.create_table(
        "metric",
        _cell(),
        sa.Column("iteration", sa.BigInteger, primary_key=True, autoincrement=False),
        sa.Column("split", TEXT, primary_key=True),
        sa.Column("name", TEXT, primary_key=True),
        sa.Column("attempt", sa.BigInteger, nullable=False),
        sa.Column("episodes", sa.BigInteger, nullable=False),
        sa.Column("steps", sa.BigInteger, nullable=False),
        sa.Column("simulated_seconds", sa.Double, nullable=False),
        sa.Column("seconds", sa.Double, nullable=False),
        sa.Column("value", sa.Double),
        sa.Column("kind", TEXT, nullable=False),
        sa.Column("episode_values", sa.LargeBinary),
    )
    op.create_table(
        "checkpoint",
        _cell(),
        sa.Column("iteration", sa.BigInteger, primary_key=True, autoincrement=False),
        sa.Column("position", sa.BigInteger, primary_key=True, autoincrement=False),
        sa.Column("complete", sa.Boolean, nullable=False),
        sa.Column("attempt", sa.BigInteger, nullable=False),
        sa.Column("episodes", sa.BigInteger, nullable=False),
        *_file(),
    )
    op.create_table(
        "artifact",
        _cell(),
        sa.Column("kind", TEXT, primary_key=True),
        sa.Column("iteration", sa.BigInteger, nullable=False),
        sa.Column("attempt", sa.BigInteger, nullable=False),
        *_file(),
    )


def _cell() -> sa.Column[str]:
    return sa.Column("cell", TEXT, sa.ForeignKey("cell.hash", ondelete="CASCADE"), primary_key=True)


def _file() -> list[sa.Column[object]]:
    return [
        sa.Column("path", TEXT, nullable=False),
        sa.Column("sha256", TEXT, nullable=False),
        sa.Column("bytes", sa.BigInteger, nullable=False),
        sa.Column("created", MOMENT, nullable=False),
    ]
