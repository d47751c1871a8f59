"""Entries of the slot `light`: one module a model, with `ENTRY`."""
