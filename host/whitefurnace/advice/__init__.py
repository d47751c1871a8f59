"""Derives which parts of a bake a scene needs, and the error that each approximation makes on it."""
