"""Renders spheres as an engine shades them, and the full reflectance integral of the same pixels."""
