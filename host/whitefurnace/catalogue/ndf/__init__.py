"""Entries of the slot `ndf`: one module for each model, with `ENTRY`."""
