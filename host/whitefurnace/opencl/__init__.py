"""Devices, assembled kernel text and launches: the only package that imports pyopencl."""
