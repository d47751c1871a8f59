"""Entries of the slot `masking`: one module for each model, with `ENTRY`."""
