"""Entries of the slot `diffuse`: one module a model, with `ENTRY`."""
