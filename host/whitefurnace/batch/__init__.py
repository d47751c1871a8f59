"""Runs many bakes and tables from one job file, in processes or on a cluster."""
