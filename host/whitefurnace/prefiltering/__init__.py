"""Integrates an environment against a lobe for every texel of a chain of cubemaps."""
