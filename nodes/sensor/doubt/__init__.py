"""Why the readings of a frame are not to be trusted: rest, sign, range and repetition."""
