"""Integrates BRDFs over angles on grids of parameters."""
