"""Geometry of the sphere: grids of texels, environments, spherical harmonics, suns."""
