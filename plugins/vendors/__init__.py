"""Plug-in `vendors`: exports of the programs that come with sensors, as recordings."""
