"""Fault records: their definition, how they grow, and COMTRADE files (IEEE C37.111)."""
