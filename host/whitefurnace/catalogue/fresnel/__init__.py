"""Entries of the slot `fresnel`: one module for each model, with `ENTRY`."""
