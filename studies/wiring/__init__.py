"""Accuracy against the length of wires."""
