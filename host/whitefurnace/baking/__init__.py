"""Bakes an environment: from a request to files and their manifest."""
