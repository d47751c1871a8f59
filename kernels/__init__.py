"""The OpenCL sources, as package data; `whitefurnace.source` composes programs from them."""
