"""Entries of the slot `diffuse`: one module for each model, with `ENTRY`."""
