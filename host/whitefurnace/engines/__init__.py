"""Describes which files each engine loads and how it reads them, and writes the shader snippets that do so."""
