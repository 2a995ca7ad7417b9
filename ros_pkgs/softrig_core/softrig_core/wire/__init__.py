"""Messages as bytes: types, layouts, signals, recordings."""
