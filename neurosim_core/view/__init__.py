"""Pictures for people: Rerun, live or to a file, and one overview of a flight."""
