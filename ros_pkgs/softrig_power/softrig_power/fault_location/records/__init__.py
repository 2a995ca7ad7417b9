"""Fault records: what one is, how it grows, and COMTRADE files (IEEE C37.111)."""
