"""Plug-in `cluster`: the workers of a Dask cluster as an executor."""
