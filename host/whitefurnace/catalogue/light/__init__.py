"""Entries of the slot `light`: one module for each model, with `ENTRY`."""
