"""Plug-in `zarr`: folders of Zarr as recordings, and bags as such folders."""
