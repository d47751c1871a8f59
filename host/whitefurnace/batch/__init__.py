"""Runs many bakes and tables from one job file on processes or a cluster."""
