"""Two-terminal fault location on a 400 kV line (Faramarzi and Ghaffarzadeh): plant, record, locator."""
