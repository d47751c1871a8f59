"""Checks that hold every model against exact values."""
