"""The store: tables, connections, spatial search and queries."""
