"""Renders spheres as an engine shades them, beside the full reflectance integral."""
