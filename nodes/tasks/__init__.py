"""Independent tasks of offline runs, and the executors that compute them."""
