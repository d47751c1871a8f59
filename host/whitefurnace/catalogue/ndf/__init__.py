"""Entries of the slot `ndf`: one module a model, with `ENTRY`."""
