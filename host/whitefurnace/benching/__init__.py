"""Measures the throughput of kernels and the trade of error against time."""
