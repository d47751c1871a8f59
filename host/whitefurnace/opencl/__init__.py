"""Devices, assembled kernel text and launches: the only door to pyopencl."""
