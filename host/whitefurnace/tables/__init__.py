"""Lookup tables: one module a kind of table."""
