"""Derives what a scene needs of a bake and what each approximation costs on it."""
