"""The files of a bag: MCAP and SQLite, whole or cut, read and written, and their metadata."""
