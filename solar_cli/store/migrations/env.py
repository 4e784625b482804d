"""Alembic runs this file: migrate on the connection, and in the transaction, of the caller."""

from alembic import context

from solar_cli.store.schema import Base

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=Base.metadata,
    transactional_ddl=True,
)
with context.begin_transaction():
    context.run_migrations()
