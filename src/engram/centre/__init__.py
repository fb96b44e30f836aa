"""What a centre on a server needs beyond maps in files: maps in PostgreSQL."""
