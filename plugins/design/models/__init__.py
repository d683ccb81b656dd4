"""Models of the parts of a skin: converters, edge, bus, host, wires; and rigs to check them."""
