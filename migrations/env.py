"""Runs migrations on the connection that app/registry/database.py passes in, inside its transaction."""

from __future__ import annotations

from alembic import context

from app.registry.tables import metadata

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=metadata,
    render_as_batch=True,
)
context.run_migrations()
