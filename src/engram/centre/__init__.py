"""Maps in PostgreSQL, for a fleet map on a server."""
