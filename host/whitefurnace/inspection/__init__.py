"""Explains files that engines load and compares two of them."""
