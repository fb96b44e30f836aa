"""A map on disk: revisions, transactions, integrity, history."""
