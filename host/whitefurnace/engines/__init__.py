"""Presets: what each game engine loads, and the shader snippets that read it."""
