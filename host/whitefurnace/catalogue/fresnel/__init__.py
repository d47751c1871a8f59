"""Entries of the slot `fresnel`: one module a model, with `ENTRY`."""
