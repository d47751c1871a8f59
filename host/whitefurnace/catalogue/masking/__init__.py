"""Entries of the slot `masking`: one module a model, with `ENTRY`."""
