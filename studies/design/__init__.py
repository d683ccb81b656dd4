"""Speed, bytes, wires and accuracy of a skin that is not built yet."""
